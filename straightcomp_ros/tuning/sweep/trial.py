"""One trial: one machine within the uncertainty of the stage's description, one cycle of the stage under each law.

Trial k of a seed is the same in any process and order: its random numbers come from the k-th child of the seed
(:class:`numpy.random.SeedSequence`), in four streams, so that a longer stroke or another parameter's range changes no
other quantity. numpy promises the bits of its distributions within a version only.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from straightcomp_ros.analysis.judged_motion import JudgedMotion
from straightcomp_ros.analysis.judgement import INACCURATE, Verdict
from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.analysis.run_verdict import verdict_of
from straightcomp_ros.control.law import Law
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.stage.description import Factors, StageParameters, deviating
from straightcomp_ros.straightness.feedforward import along
from straightcomp_ros.straightness.survey import Survey


@dataclass(frozen=True)
class TrialResult:
    """Figures of one law on one machine."""

    trial: int  # number of the trial, from 0
    law: str  # name of the law
    pp: float  # true compensation error, peak to peak in m, over the motion; infinite if the cycle broke off
    rms: float  # the same, root mean square about zero
    control_activity: float  # Σ |Δ i_c| over the motion, A; infinite if the cycle broke off
    control_rms_step: float  # root mean square of Δ i_c from sample to sample, A; likewise
    verdict: Verdict  # on the cycle, see :mod:`straightcomp_ros.analysis.run_verdict`


class Streams(NamedTuple):
    """Random numbers of one trial, by purpose."""

    machine: Generator
    sensor: Generator
    clock: Generator
    survey: Generator


def run_trial(scenario: Scenario, laws: Mapping[str, Law], seed: int, trial: int) -> list[TrialResult]:
    """One result for each of ``laws``, all on the same machine; depends on nothing but the arguments.

    Raises:
        SurveyError: the survey with its errors gives no map within the platform's travel.
        MetricsError: the stage does not move.
    """
    random, stage, nominal = streams(seed, trial), scenario.description, scenario.driver.plant
    factors, sensor_noise, delay = draw(stage, random.machine)
    plant = deviating(nominal, factors)
    stamps = sample_times(stage.uncertainty.jitter * stage.period, scenario.period_ns, scenario.samples, random.clock)
    stroke = scenario.stroke(stamps, mismeasured(scenario.survey, stage.uncertainty.map_noise, random.survey))
    noise = sensor_noise * random.sensor.standard_normal(stamps.size)
    time = np.asarray(stamps * 1e-9, dtype=np.float64)
    window, target = motion_of(time, stroke.x).window, along(stroke.map, stroke.true_x)[0]
    first, last = stroke.map.span
    bounds: dict[str, Any] = {
        "current_limit": min(stage.actuator.current_limit, nominal.drive.largest_current),
        "stop": nominal.platform.stop,
        "span": (first - stage.guide.runout, last + stage.guide.runout),
    }
    results = []
    for name, law in laws.items():
        cycle = scenario.cycle(law, stroke, delay, noise, plant)
        if cycle.current.size < stamps.size:
            broken = Verdict(INACCURATE, "position or current not finite")
            results.append(TrialResult(trial, name, *(math.inf,) * 4, broken))
            continue
        y, r, current = cycle.true_y[window], target[window], cycle.current[window]
        count = nominal.encoder.y_resolution
        judged = JudgedMotion(time[window], stroke.true_x[window], y, r, current, r - y, count, **bounds)
        steps = np.diff(current)
        rms, rms_step = (float(np.sqrt(np.mean(values * values))) for values in (judged.error, steps))
        activity = float(np.abs(steps).sum())
        results.append(TrialResult(trial, name, judged.pp, rms, activity, rms_step, verdict_of(judged)))
    return results


def streams(seed: int, trial: int) -> Streams:
    """The random numbers of trial ``trial`` (from 0), as of ``SeedSequence(seed).spawn(n)[trial]`` for any n."""
    children = SeedSequence(seed, spawn_key=(trial,)).spawn(len(Streams._fields))
    return Streams(*map(default_rng, children))


def draw(stage: StageParameters, random: Generator) -> tuple[Factors, float, float]:
    """A machine within the uncertainty of ``stage``: relative to its description, the noise of its sensor in m, and the
    delay of its commands in samples."""
    ranges = stage.uncertainty
    u = random.random(7).tolist()
    factors = Factors(
        mass=1.0 + ranges.mass * (2.0 * u[0] - 1.0),
        force=1.0 + ranges.force * (2.0 * u[1] - 1.0),
        air_gap=1.0 + ranges.air_gap * (2.0 * u[2] - 1.0),
        friction=ranges.friction ** (2.0 * u[3] - 1.0),
        amplifier=ranges.amplifier ** (2.0 * u[6] - 1.0),
    )
    if stage.platform.modes.present:
        frequency, damping, participation = (2.0 * random.random(3) - 1.0).tolist()
        factors = factors._replace(modes=(frequency, damping, participation))
    sensor_noise = ranges.sensor_noise * stage.encoder.y_resolution * u[4]
    late = ranges.shortest_delay + (ranges.longest_delay - ranges.shortest_delay) * u[5]
    return factors, sensor_noise, stage.drive.delay * late


def sample_times(jitter: float, period_ns: int, count: int, random: Generator) -> NDArray[np.int64]:
    """Stamps (count,) in ns from 0, around a grid of ``period_ns``; ``jitter`` in s does not add up."""
    largest = round(jitter * 1e9)
    stamps = np.arange(count) * period_ns + random.integers(-largest, largest, count, endpoint=True)
    stamps[0] = 0
    return stamps


def mismeasured(survey: Survey, noise: float, random: Generator) -> Survey:
    """``survey`` with an error of standard deviation ``noise`` (m) in each point."""
    errors = [noise * random.standard_normal(run.x.size) for run in survey.runs]
    runs = [dataclasses.replace(run, deviation=run.deviation + e) for run, e in zip(survey.runs, errors, strict=True)]
    return Survey(tuple(runs), survey.source)
