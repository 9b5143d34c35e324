"""The loop that the figures are computed with: as shipped, or idealised; its release, and its sine.

The loop runs on its own: any initial position, any reference over time, no guide and no map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.model.plant import PlantParameters, advance, plant_state
from straightcomp_ros.offline.scenario import node_set
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters

_DELAY = 0.5
"""Command delay of the paper's loop, in samples; the shipped friction was fitted with it."""
IDEAL_RATE = 20_000
"""Samples per second of the idealised loop: ten times the machine's, so that σ chatters a tenth as wide."""
UNCLAMPED = 100.0
"""Limit of |i_c| in A that no law here comes near before the platform is at its stop."""
FREQUENCY = 0.8
"""Of the sine of Fig. 6 and 7, Hz."""
AMPLITUDE = 50e-6
"""m."""
SETTLING_PERIODS = 2
PERIODS = 2
"""Periods that are evaluated, after those in which the loop settles."""
OMEGA = 2.0 * math.pi * FREQUENCY


@dataclass(frozen=True)
class Machine:
    """Plant and control law of one sampled loop."""

    plant: PlantParameters  # platform, magnets, friction, drive and encoders
    control: ControlParameters  # law and design
    stage: StageParameters  # the description that the law has; its rate and delay are the loop's
    values: Values  # parameters by node and dotted name that the machine was made from

    @property
    def gap(self) -> float:
        """y0 in m."""
        return self.plant.actuator.air_gap

    @property
    def bias(self) -> float:
        """I0 in A."""
        return self.plant.actuator.bias_current

    @property
    def stop(self) -> float:
        """|y| in m at the mechanical stops."""
        return self.plant.platform.stop

    def with_law(self, law: str) -> Machine:
        """The same machine under another law."""
        return replace(self, control=replace(self.control, law=law))

    def with_limit(self, current: float) -> Machine:
        """The same machine with |i_c| limited to ``current`` in A."""
        actuator = replace(self.stage.actuator, current_limit=current)
        return replace(self, stage=replace(self.stage, actuator=actuator))

    def without_friction(self) -> Machine:
        """The same machine on bristles too weak to matter (a friction of zero is no LuGre friction)."""
        friction = replace(self.plant.friction, coulomb=1e-9, static=1e-9, bristle_damping=0.0, viscous=0.0)
        return replace(self, plant=replace(self.plant, friction=friction))

    def idealised(self) -> Machine:
        """The loop that the paper's equations speak of: fast, without delay, quanta and limits; sgn σ as written.

        Magnets, mass and friction stay as they are.
        """
        drive = replace(self.plant.drive, dac_bits=24, dac_range=UNCLAMPED / self.plant.drive.gain, bandwidth=1e6)
        smc = replace(self.control.smc, boundary_layer=0.0, velocity_bandwidth=1e5, enforce_reaching=False)
        free = self.with_limit(UNCLAMPED)
        return replace(
            free,
            plant=replace(self.plant, drive=drive, encoder=EncoderParameters(1e-12, 1e-12)),
            stage=replace(free.stage, rate=IDEAL_RATE, drive=replace(drive, delay=0.0)),
            control=replace(self.control, smc=smc),
        )

    def samples(self, duration: float) -> int:
        """How many samples the loop takes in ``duration`` s."""
        return round(duration * self.stage.rate)


def paper_machine() -> Machine:
    """The machine of the shipped parameters, but for the paper's delay."""
    values = shipped_parameters()
    values["stage"]["drive.delay"] = _DELAY
    driver, _, controller, _ = node_set(values)
    return Machine(plant=driver.plant, control=controller.control, stage=controller.stage, values=values)


class Response(NamedTuple):
    """What the loop did; all arrays (n,), sample k of each at the same time."""

    time: NDArray[np.float64]  # s from the release
    reference: NDArray[np.float64]  # r, m
    reading: NDArray[np.float64]  # y as the encoder sees it, m
    y: NDArray[np.float64]  # true position, m
    velocity: NDArray[np.float64]  # true ẏ, m/s
    coil_current: NDArray[np.float64]  # control current in the coils, A
    friction: NDArray[np.float64]  # force of friction, N, positive where it resists a positive velocity
    command: NDArray[np.float64]  # i_c asked by the law, A
    sigma: NDArray[np.float64]  # sliding variable as the law computes it, m/s


def release(machine: Machine, initial_y: float, reference: NDArray[np.float64]) -> Response:
    """Release the platform at rest at ``initial_y`` in m, bias current on, control current zero, and run the loop along
    ``reference`` (n,) in m. The law is given r and no rates of it, as the paper's is."""
    period_ns = machine.stage.period_ns
    delay_ns = round(machine.stage.drive.delay * period_ns)
    constants = machine.plant.constants()
    state = plant_state(y=initial_y, bias=machine.bias)
    reading, converted = machine.plant.encoder.y_reading, machine.plant.drive.converted
    law = make_law(machine.control, machine.stage)
    law.reset(reading(initial_y))
    applied = 0.0
    rows = np.empty((len(reference), 7))
    for index, r in enumerate(reference.tolist()):
        y, velocity, _, control, _, friction, *_ = state.tolist()
        seen = reading(y)
        command = law.step(seen, r, 0.0, 0.0)
        rows[index] = seen, y, velocity, control, friction, command.current, command.sliding_variable
        asked = converted(command.current)
        advance(constants, state, machine.bias, applied, delay_ns, asked, period_ns - delay_ns)
        applied = asked
    time = np.arange(len(reference), dtype=np.float64) * (period_ns * 1e-9)
    return Response(time, reference, *rows.T.copy())


def follow_sine(machine: Machine) -> Response:
    """Run the loop from rest along the sine."""
    count = machine.samples((SETTLING_PERIODS + PERIODS) / FREQUENCY)
    return release(machine, 0.0, AMPLITUDE * np.sin(OMEGA * np.arange(count) / machine.stage.rate))


def evaluated(response: Response) -> Response:
    """The last periods of the sine, those that are evaluated."""
    window = response.time >= SETTLING_PERIODS / FREQUENCY - 1e-9
    return Response(*(values[window] for values in response))


def fundamental(time: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """Amplitude of the part of ``values`` at the sine's frequency, over whole periods."""
    return 2.0 * abs(complex(np.mean(values * np.exp(-1j * OMEGA * time))))
