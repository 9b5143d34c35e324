"""What all trials of a sweep have in common: the nominal machine, the motion, the survey and the laws' design."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.model.motion import Trajectory, forward_and_back
from straightcomp_ros.offline.simulation import node_set
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import DriverNodeParameters, Values
from straightcomp_ros.stage.description import Factors, StageParameters, deviating
from straightcomp_ros.straightness.feedforward import FeedforwardParameters
from straightcomp_ros.straightness.guide_map import find_survey
from straightcomp_ros.straightness.survey import Survey, read_survey

LOWEST_RATE = 100
"""Hz; below, a period comes near the gap after which the Servo restarts a law, which the kernel does not model."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A sweep without its seed: self-contained, so that it can be sent to a worker that has no files.

    The guide is left out: the error under r(x) does not depend on how straight the guide truly is.

    Attributes:
        driver: the simulated machine.
        description: of the stage, as the controller has it.
        controls: parameters of each law, by its name.
        feedforward: tracking of the stage.
        lead_ns: how much older than a sample its reference is, in ns.
        trajectory: motion of the stage, one cycle.
        survey: the measurement for the controller's map.
    """

    driver: DriverNodeParameters
    description: StageParameters
    controls: Mapping[str, ControlParameters]
    feedforward: FeedforwardParameters
    lead_ns: int
    trajectory: Trajectory
    survey: Survey

    def on(self, stage: StageParameters) -> Scenario:
        """The same on another stage: controller and machine have its description."""
        return dataclasses.replace(self, description=stage, driver=dataclasses.replace(self.driver, stage=stage))

    @property
    def period_ns(self) -> int:
        """Sampling period in ns."""
        return self.description.period_ns

    @property
    def samples(self) -> int:
        """Samples of a cycle."""
        return -(-self.trajectory.end_ns // self.period_ns)

    def positions(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """True x (n,) in m at ``stamps`` (n,) in ns."""
        return np.array([self.trajectory.position(stamp) for stamp in stamps.tolist()])


def make_scenario(values: Values, laws: Sequence[str]) -> Scenario:
    """The scenario under the parameters of the nodes, as `Simulation` takes them.

    Args:
        values: parameters by node and dotted name.
        laws: names of the laws; all run on the same machines. `control.law` is not read.

    Raises:
        ParameterError: a parameter is refused, rates differ, or a machine within the ranges is impossible.
        SurveyError: the survey is refused.
    """
    controls = {}
    for law in laws:
        nodes = node_set({**values, "controller": {**values.get("controller", {}), "control.law": law}})
        driver, feedforward, controller, cell = nodes
        nodes.check_rates()
        rate = controller.stage.rate
        if rate < LOWEST_RATE:
            raise ParameterError(f"parameter 'stage.rate': {rate} Hz; allowed in a sweep: >= {LOWEST_RATE}")
        controls[law] = controller.control
    guide_map = feedforward.stage.guide
    scenario = Scenario(
        driver=driver,
        description=controller.stage,
        controls=controls,
        feedforward=feedforward.feedforward,
        lead_ns=controller.lead_ns,
        trajectory=Trajectory(forward_and_back(cell.stage.motion)),
        survey=read_survey(find_survey(guide_map.file), min_points=guide_map.min_points, max_gap=guide_map.max_gap),
    )
    _check(scenario)
    return scenario


def _check(scenario: Scenario) -> None:
    machine, stage = scenario.driver.simulated, scenario.description
    deviating(scenario.driver.plant, Factors(air_gap=1.0 - stage.uncertainty.air_gap))
    # The oldest command on the board is a period and twice the jitter old, even if it acts at once.
    oldest = stage.period * (1.0 + 2.0 * stage.uncertainty.jitter)
    if machine.command_timeout < oldest:
        raise ParameterError(
            f"node driver: parameter 'simulated.command_timeout': {machine.command_timeout!r} s; "
            f"allowed in a sweep: >= {oldest:.4g} s, a period and twice the jitter"
        )


def laws_of(scenario: Scenario) -> dict[str, Law]:
    """The scenario's laws, ready to run."""
    return {law: make_law(control, scenario.description) for law, control in scenario.controls.items()}
