"""One trial: one machine within the uncertainty, one cycle of the stage under each law."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import StrokeRecord, find_motion
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.model.plant import PlantState
from straightcomp_ros.offline.sweep.draws import Streams, draw, mismeasured, sample_times, streams
from straightcomp_ros.offline.sweep.kernel import Conditions, Cycle, run_cycle
from straightcomp_ros.offline.sweep.limit_cycle import LEAST_AMPLITUDE, LOWEST_FREQUENCY, sustained_oscillation
from straightcomp_ros.offline.sweep.references import readings, references, served
from straightcomp_ros.offline.sweep.scenario import Scenario
from straightcomp_ros.stage.truth import deviating
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak

LARGEST_PP = 10e-6
"""True peak-to-peak error in m beyond which a trial has failed: half of what the guide does uncompensated."""


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
        oscillation: amplitude in m of the strongest held line in the true error, 0 without one.
        frequency: of that line, Hz.
        limit_cycle: whether the line is one, see :mod:`straightcomp_ros.offline.sweep.limit_cycle`.
        failure: why the trial failed, empty if it did not.
    """

    trial: int
    law: str
    pp: float
    rms: float
    control_activity: float
    control_rms_step: float
    oscillation: float
    frequency: float
    limit_cycle: bool
    failure: str


class _Course(NamedTuple):
    """The same for all laws of a trial: samples of the motion, r(true x) in m, and frequency in Hz above the map's."""

    window: slice
    target: NDArray[np.float64]
    lowest: float


def laws_of(scenario: Scenario) -> dict[str, Law]:
    """The scenario's laws, ready to run."""
    return {law: make_law(control, scenario.description) for law, control in scenario.controls.items()}


def run_trial(scenario: Scenario, laws: Mapping[str, Law], seed: int, trial: int) -> list[TrialResult]:
    """One result for each of ``laws``, all on the same machine; depends on nothing but the arguments.

    Raises:
        SurveyError: the survey with its errors gives no map within the platform's travel.
        MetricsError: the stage does not move.
    """
    random, board = streams(seed, trial), scenario.driver.simulated
    uncertainty = scenario.description.uncertainty
    deviation = draw(uncertainty, random.machine)
    plant = deviating(scenario.driver.plant, deviation.factors)
    stamps = sample_times(uncertainty.jitter, scenario.period_ns, scenario.samples, random.clock)
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
    r, time = given[:, 0], np.asarray(stamps * 1e-9, dtype=np.float64)
    # The motion depends on x alone.
    motion = find_motion(StrokeRecord(time=time, x=x, y=r, r=r, current=np.zeros_like(r), law=""))
    top_speed = float(np.abs(np.diff(true_x) / np.diff(time)).max())
    pitch = float(np.median(np.diff(survey.runs[0].x)))
    lowest = max(LOWEST_FREQUENCY, top_speed / pitch)
    return given, _Course(motion.window, straightness.evaluate(true_x)[0], lowest)


def _judged(scenario: Scenario, trial: int, law: str, course: _Course, cycle: Cycle) -> TrialResult:
    if cycle.current.size < scenario.samples:
        broken = (math.inf,) * 4
        return TrialResult(trial, law, *broken, 0.0, 0.0, False, "position or current not finite")
    plant = scenario.driver.plant
    error = (course.target - cycle.true_y)[course.window]
    pp = peak_to_peak(error)
    failure = ""
    if np.abs(cycle.true_y).max() >= plant.platform.stop:
        failure = "mechanical stop"
    elif pp > LARGEST_PP:
        failure = f"error beyond {LARGEST_PP * 1e6:g} µm"
    steps = np.diff(cycle.current[course.window])
    oscillation = sustained_oscillation(error, scenario.period_ns * 1e-9, course.lowest)
    return TrialResult(
        trial=trial,
        law=law,
        pp=pp,
        rms=float(np.sqrt(np.mean(error * error))),
        control_activity=float(np.abs(steps).sum()),
        control_rms_step=float(np.sqrt(np.mean(steps * steps))),
        oscillation=oscillation.amplitude,
        frequency=oscillation.frequency,
        limit_cycle=oscillation.amplitude > max(LEAST_AMPLITUDE, plant.encoder.y_resolution),
        failure=failure,
    )
