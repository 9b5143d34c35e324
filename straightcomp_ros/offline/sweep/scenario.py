"""What all trials of a sweep have in common: the nominal machine, the motion, the survey and the laws' design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from straightcomp_ros.configuration.node_parameters import (
    CellNodeParameters,
    ControllerNodeParameters,
    DriverNodeParameters,
    FeedforwardNodeParameters,
    node_parameters,
)
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.model.stage import Trajectory, forward_and_back
from straightcomp_ros.offline.sweep.uncertainty import Deviation, UncertaintyParameters, deviating
from straightcomp_ros.settings.declaration import ParameterError
from straightcomp_ros.straightness.feedforward import FeedforwardParameters
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey
from straightcomp_ros.straightness.survey import Survey, read_survey

LOWEST_RATE = 100
"""Hz; at less, a period comes near the gap after which the Servo starts a law anew, which the kernel leaves out."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A sweep without its seed: self-contained, so that it can be sent to a worker that has no files.

    Attributes:
        driver: machine, and the rate of its samples.
        controls: parameters of each law, by its name.
        feedforward: tracking of the stage.
        lead_ns: how much older than a sample its reference is, in ns.
        trajectory: motion of the stage, one cycle.
        survey: the measurement that the controller's map is made from.
        map_parameters: how the map is made.
        uncertainty: ranges of what is drawn for each trial.

    The guide is no part of it: what the servo leaves of r(x) does not depend on how straight the guide truly is.
    """

    driver: DriverNodeParameters
    controls: Mapping[str, ControlParameters]
    feedforward: FeedforwardParameters
    lead_ns: int
    trajectory: Trajectory
    survey: Survey
    map_parameters: MapParameters
    uncertainty: UncertaintyParameters = field(default_factory=UncertaintyParameters)

    @property
    def period_ns(self) -> int:
        """Sampling period in ns."""
        return round(1e9 / self.driver.simulated.rate)

    @property
    def samples(self) -> int:
        """Samples of a cycle."""
        return -(-self.trajectory.end_ns // self.period_ns)


def make_scenario(
    values: Mapping[str, Mapping[str, Any]], laws: Sequence[str], uncertainty: UncertaintyParameters | None = None
) -> Scenario:
    """The scenario under the parameters of the nodes, as `Simulation` takes them.

    Args:
        values: parameters by node and dotted name.
        laws: names of the laws; each runs on the very same machines. `control.law` is not read.
        uncertainty: ranges; the default ones if None. The driver's `lockstep_delay` is not read.

    Raises:
        ParameterError: a parameter is refused, rates differ, or a machine within the ranges is impossible.
        SurveyError: the survey is refused.
    """
    driver: DriverNodeParameters = node_parameters("driver", values.get("driver", {}))
    feedforward: FeedforwardNodeParameters = node_parameters("feedforward", values.get("feedforward", {}))
    cell: CellNodeParameters = node_parameters("cell", values.get("cell", {}))
    rate = driver.simulated.rate
    if rate < LOWEST_RATE:
        raise ParameterError(
            f"node driver: parameter 'simulated.rate': {rate} Hz; allowed in a sweep: >= {LOWEST_RATE}"
        )
    controls = {}
    for law in laws:
        controller: ControllerNodeParameters = node_parameters(
            "controller", {**values.get("controller", {}), "control.law": law}
        )
        if controller.rate != rate:
            raise ParameterError(
                f"node controller: parameter 'rate': {controller.rate} Hz; allowed: {rate} Hz, as the driver has"
            )
        controls[law] = controller.control
    scenario = Scenario(
        driver=driver,
        controls=controls,
        feedforward=feedforward.feedforward,
        lead_ns=controller.lead_ns,
        trajectory=Trajectory(forward_and_back(cell.motion)),
        survey=read_survey(
            find_survey(feedforward.map.file), min_points=feedforward.map.min_points, max_gap=feedforward.map.max_gap
        ),
        map_parameters=feedforward.map,
        uncertainty=uncertainty or UncertaintyParameters(),
    )
    _check(scenario)
    return scenario


def _check(scenario: Scenario) -> None:
    ranges, period = scenario.uncertainty, scenario.period_ns * 1e-9
    narrowest = Deviation(1.0, 1.0, 1.0 - ranges.air_gap, 1.0, 0.0, 0.0)
    deviating(scenario.driver.simulated.plant, narrowest)
    if ranges.jitter > 0.4 * period:
        raise ParameterError(
            f"parameter 'jitter': {ranges.jitter!r} s; allowed: <= {0.4 * period:.4g} s, four tenths of the period, "
            "so that samples keep their order"
        )
    # The oldest command that the board sees: a period and twice the jitter old, if it acts at once.
    if scenario.driver.simulated.command_timeout < period + 2.0 * ranges.jitter:
        raise ParameterError(
            f"node driver: parameter 'simulated.command_timeout': {scenario.driver.simulated.command_timeout!r} s; "
            f"allowed in a sweep: >= {period + 2.0 * ranges.jitter:.4g} s, a period and twice the jitter"
        )
