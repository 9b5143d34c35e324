"""The machine and the law that the figures are computed with: as a parameter file says, or idealised."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, DriverNodeParameters, node_parameters
from straightcomp_ros.stage.description import StageParameters

DELAY = 0.5
"""Command delay of the paper's loop, in samples; the shipped friction was fitted with it."""
IDEAL_RATE = 20_000
"""Samples per second of the idealised loop: ten times the machine's, so that σ chatters a tenth as wide."""
UNCLAMPED = 100.0
"""Limit of |i_c| in A that no law here comes near before the platform is at its stop."""


@dataclass(frozen=True)
class Machine:
    """Plant and control law of one sampled loop.

    Attributes:
        plant: platform, magnets, friction, drive and encoders.
        control: law and design.
        stage: the description that the law has; its rate and delay are the loop's.
        values: parameters by node and dotted name that the machine was made from.
    """

    plant: PlantParameters
    control: ControlParameters
    stage: StageParameters
    values: Mapping[str, Mapping[str, Any]]

    def with_law(self, law: str) -> Machine:
        """The same machine under another law."""
        return dataclasses.replace(self, control=dataclasses.replace(self.control, law=law))

    def with_limit(self, current: float) -> Machine:
        """The same machine with |i_c| limited to ``current`` in A."""
        return dataclasses.replace(self, stage=_limited(self.stage, current))

    def without_friction(self) -> Machine:
        """The same machine on bristles too weak to matter (a friction of zero is no LuGre friction)."""
        friction = dataclasses.replace(self.plant.friction, coulomb=1e-9, static=1e-9, bristle_damping=0.0, viscous=0.0)
        return dataclasses.replace(self, plant=dataclasses.replace(self.plant, friction=friction))

    def idealised(self) -> Machine:
        """The loop that the paper's equations speak of: fast, without delay, quanta and limits; sgn σ as written.

        Magnets, mass and friction stay as they are.
        """
        drive = dataclasses.replace(
            self.plant.drive, dac_bits=24, dac_range=UNCLAMPED / self.plant.drive.gain, bandwidth=1e6
        )
        plant = dataclasses.replace(self.plant, drive=drive, encoder=EncoderParameters(1e-12, 1e-12))
        ideal_drive = dataclasses.replace(self.stage.drive, delay=0.0)
        stage = dataclasses.replace(_limited(self.stage, UNCLAMPED), rate=IDEAL_RATE, drive=ideal_drive)
        control = dataclasses.replace(
            self.control,
            smc=dataclasses.replace(
                self.control.smc, boundary_layer=0.0, velocity_bandwidth=1e5, enforce_reaching=False
            ),
        )
        return dataclasses.replace(self, plant=plant, control=control, stage=stage)


def machine_from(values: Mapping[str, Mapping[str, Any]]) -> Machine:
    """The machine of a parameter file, values as `read_parameter_file` gives them.

    Raises:
        ParameterError: a parameter is refused.
    """
    driver: DriverNodeParameters = node_parameters("driver", values)
    controller: ControllerNodeParameters = node_parameters("controller", values)
    return Machine(plant=driver.plant, control=controller.control, stage=controller.stage, values=values)


def _limited(stage: StageParameters, current: float) -> StageParameters:
    return dataclasses.replace(stage, actuator=dataclasses.replace(stage.actuator, current_limit=current))
