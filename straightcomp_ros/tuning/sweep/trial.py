"""One trial: one machine within the uncertainty, one cycle of the stage under each law."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.judgement import INACCURATE, Verdict
from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.analysis.run_verdict import Bounds, JudgedMotion, verdict_of
from straightcomp_ros.control.law import Law
from straightcomp_ros.model.plant import PlantState
from straightcomp_ros.offline.kernel import Conditions, Cycle, run_cycle
from straightcomp_ros.offline.references import readings, references, served
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.stage.description import deviating
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.tuning.sweep.draws import Streams, draw, mismeasured, sample_times, streams


@dataclass(frozen=True)
class TrialResult:
    """Figures of one law on one machine.

    Attributes:
        trial: number of the trial, from 0.
        law: name of the law.
        pp: true compensation error, peak to peak in m, over the motion; infinite if the cycle broke off.
        rms: the same, root mean square about zero.
        control_activity: Σ |Δ i_c| over the motion, A; infinite if the cycle broke off.
        control_rms_step: root mean square of Δ i_c from sample to sample, A; likewise.
        verdict: on the cycle, see :mod:`straightcomp_ros.analysis.run_verdict`.
    """

    trial: int
    law: str
    pp: float
    rms: float
    control_activity: float
    control_rms_step: float
    verdict: Verdict


class _Course(NamedTuple):
    """The same for all laws of a trial: time of the samples in s, true x and r(true x) in m, (n,) each; samples of the
    motion; and x in m from which and up to which the map has a reference."""

    time: NDArray[np.float64]
    true_x: NDArray[np.float64]
    target: NDArray[np.float64]
    window: slice
    bounds: Bounds


def run_trial(scenario: Scenario, laws: Mapping[str, Law], seed: int, trial: int) -> list[TrialResult]:
    """One result for each of ``laws``, all on the same machine; depends on nothing but the arguments.

    Raises:
        SurveyError: the survey with its errors gives no map within the platform's travel.
        MetricsError: the stage does not move.
    """
    random, board = streams(seed, trial), scenario.driver.simulated
    stage = scenario.description
    deviation = draw(stage, random.machine)
    plant = deviating(scenario.driver.plant, deviation.factors)
    stamps = sample_times(stage.uncertainty.jitter * stage.period, scenario.period_ns, scenario.samples, random.clock)
    given, course = _follow(scenario, stamps, random)
    conditions = Conditions(
        stamps=stamps,
        delays=np.full(stamps.size, round(deviation.delay * scenario.period_ns)),
        references=served(given, stamps, scenario.lead_ns),
        noise=deviation.sensor_noise * random.sensor.standard_normal(stamps.size),
    )
    initial = PlantState(y=board.initial_y)
    return [
        _judged(scenario, trial, name, course, run_cycle(law, plant, conditions, initial, scenario.driver.hold))
        for name, law in laws.items()
    ]


def _follow(scenario: Scenario, stamps: NDArray[np.int64], random: Streams) -> tuple[NDArray[np.float64], _Course]:
    """References (n, 3) from a map of this trial, and the stage's course."""
    survey = mismeasured(scenario.survey, scenario.description.uncertainty.map_noise, random.survey)
    straightness = StraightnessMap(survey, scenario.description.guide)
    true_x = scenario.positions(stamps)
    x = readings(scenario.description.encoder.x_resolution, true_x)
    given = references(straightness, scenario.feedforward, scenario.description.motion.highest_speed, stamps, x)
    time = np.asarray(stamps * 1e-9, dtype=np.float64)
    window, target = motion_of(time, x).window, straightness.evaluate(true_x)[0]
    return given, _Course(
        time, true_x, target, window, Bounds().within(straightness, scenario.description.guide.runout)
    )


def _judged(scenario: Scenario, trial: int, law: str, course: _Course, cycle: Cycle) -> TrialResult:
    if cycle.current.size < scenario.samples:
        broken = (math.inf,) * 4
        return TrialResult(trial, law, *broken, Verdict(INACCURATE, "position or current not finite"))
    plant = scenario.driver.plant
    window = course.window
    y, r = cycle.true_y[window], course.target[window]
    judged = JudgedMotion(
        time=course.time[window],
        x=course.true_x[window],
        y=y,
        r=r,
        current=cycle.current[window],
        error=r - y,
        true=True,
        count=plant.encoder.y_resolution,
    )
    current = min(scenario.description.actuator.current_limit, plant.drive.largest_current)
    steps = np.diff(judged.current)
    return TrialResult(
        trial=trial,
        law=law,
        pp=judged.pp,
        rms=float(np.sqrt(np.mean(judged.error * judged.error))),
        control_activity=float(np.abs(steps).sum()),
        control_rms_step=float(np.sqrt(np.mean(steps * steps))),
        verdict=verdict_of(judged, course.bounds._replace(current=current, stop=plant.platform.stop)),
    )
