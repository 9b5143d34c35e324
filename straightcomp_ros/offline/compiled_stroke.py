"""One cycle of the stage, compiled: the result of `Simulation`, to the last bit, in a fifth of the time.

Only a first cycle without learning: the compiled loop starts from rest and keeps no state.
"""

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.model.plant import PlantState
from straightcomp_ros.offline.kernel import Conditions, run_cycle
from straightcomp_ros.offline.references import readings, references, served
from straightcomp_ros.offline.scenario import LOWEST_RATE, laws_of, make_scenario
from straightcomp_ros.offline.simulation import node_set
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.straightness.guide_map import StraightnessMap


def can_run(values: Values) -> bool:
    """Whether the compiled loop models a cycle under ``values``; ParameterError if a parameter is refused."""
    driver, _, controller, _ = node_set(values)
    rate = driver.stage.rate
    oldest_command = (driver.stage.drive.delay + 1.0) / rate
    return (
        rate == controller.stage.rate
        and rate >= LOWEST_RATE
        and oldest_command < driver.simulated.command_timeout
        and not controller.learning.learn
    )


def run_stroke(values: Values, delays: NDArray[np.int64] | None = None) -> tuple[StrokeRecord, StraightnessMap]:
    """The first cycle under ``values``, for which :func:`can_run` must hold, and the controller's map.

    Args:
        values: parameters by node and dotted name.
        delays: of the first commands in ns, in place of ``stage.drive.delay``, which the others have.

    Raises:
        ParameterError: a parameter is refused.
        SurveyError: the map or the guide is refused.
        ValueError: the platform's position, or the current, was not finite.
    """
    driver, _, controller, _ = node_set(values)
    law = controller.control.law
    scenario = make_scenario(values, [law])
    period_ns = scenario.period_ns
    straightness = StraightnessMap(scenario.survey, scenario.description.guide)
    stamps = np.arange(scenario.samples, dtype=np.int64) * period_ns
    true_x = scenario.positions(stamps)
    x = readings(driver.stage.encoder.x_resolution, true_x)
    given = references(straightness, scenario.feedforward, scenario.description.motion.highest_speed, stamps, x)
    given_delays = np.full(stamps.size, round(driver.stage.drive.delay * period_ns))
    if delays is not None:
        given_delays[: delays.size] = delays[: stamps.size]
    conditions = Conditions(stamps, given_delays, served(given, stamps, scenario.lead_ns), np.zeros(stamps.size))
    initial = PlantState(y=driver.simulated.initial_y)
    cycle = run_cycle(laws_of(scenario)[law], driver.plant, conditions, initial, driver.hold)
    if cycle.y.size < stamps.size:
        raise ValueError(f"law '{law}': position or control current is not finite after {cycle.y.size} samples")
    record = StrokeRecord(
        time=np.arange(stamps.size) * (period_ns * 1e-9),
        x=x,
        y=cycle.y,
        r=given[:, 0].copy(),
        current=cycle.current,
        true_x=true_x,
        true_y=cycle.true_y,
        guide=driver.guide().deviations(true_x),
        law=law,
    )
    return record, straightness
