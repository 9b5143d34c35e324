"""One trial: one machine within the uncertainty of the stage's description, one cycle of the stage under each law. Many
trials, on this machine's cores by joblib or on others by Dask, with the same numbers; their figures, and the picture of
them: the fraction of the machines at or below an error, for each law.

Trial k of a seed is the same in any process and order: its random numbers come from the k-th child of the seed
(:class:`numpy.random.SeedSequence`), in four streams, so that a longer stroke or another parameter's range changes no
other quantity. numpy promises the bits of its distributions within a version only.
"""

import dataclasses
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.judged_motion import JudgedMotion, dither_frequency
from straightcomp_ros.analysis.judgement import IN_ORDER, INACCURATE, Verdict
from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.analysis.run_verdict import verdict_of
from straightcomp_ros.analysis.style import BLUE, GREEN, GREY, VERMILION
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.margins import unstable_where
from straightcomp_ros.offline.scenario import Scenario, laws_of
from straightcomp_ros.offline.workers import spread
from straightcomp_ros.stage.description import Factors, StageParameters, deviating
from straightcomp_ros.straightness.feedforward import along
from straightcomp_ros.straightness.residual import rms
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
    stamps = sample_times(stage.uncertainty.jitter * stage.period, stage.period_ns, scenario.samples, random.clock)
    stroke = scenario.stroke(stamps, mismeasured(scenario.survey, stage.uncertainty.map_noise, random.survey))
    noise = sensor_noise * random.sensor.standard_normal(stamps.size)
    time = np.asarray(stamps * 1e-9, dtype=np.float64)
    window, target = motion_of(time, stroke.x).window, along(stroke.map, stroke.true_x)[0]
    first, last = stroke.map.span
    bounds: dict[str, Any] = {
        "current_limit": min(stage.highest_current, nominal.drive.largest_current),
        "stop": nominal.platform.stop,
        "span": (first - stage.guide.runout, last + stage.guide.runout),
        "modes": tuple(mode.frequency for mode in stage.platform.modes.present),
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
        bounds["unstable_where"] = partial(unstable_where, scenario.controls[name], stage)
        bounds["dither"] = dither_frequency(scenario.controls[name], stage)
        judged = JudgedMotion(time[window], stroke.true_x[window], y, r, current, r - y, count, **bounds)
        steps = np.diff(current)
        activity = float(np.abs(steps).sum())
        results.append(TrialResult(trial, name, judged.pp, rms(judged.error), activity, rms(steps), verdict_of(judged)))
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
    factors = ranges.factors(*(2.0 * u[k] - 1.0 for k in (0, 1, 2, 3, 6)))
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


_LARGEST_BATCH = 10
"""Trials in a batch: two seconds of work, for frequent progress at little cost of sending."""
PERCENTILES = {"p5": 5.0, "p50": 50.0, "p95": 95.0, "max": 100.0}
"""Percentiles of a distribution, by name. Each is the value of a trial: nothing is interpolated."""
_WIDE = 8.0
"""Ratio of largest to smallest error from which the axis is logarithmic."""


def run_trials(scenario: Scenario, seed: int, trials: Sequence[int]) -> list[TrialResult]:
    """The results of ``trials`` for each law, in one process."""
    laws = laws_of(scenario)
    return [result for trial in trials for result in run_trial(scenario, laws, seed, trial)]


def sweep(
    scenario: Scenario,
    seed: int,
    trials: Sequence[int],
    *,
    jobs: int = -1,
    dask: str = "",
    progress: Callable[[float], None] = lambda fraction: None,
) -> list[TrialResult]:
    """Run the trials in any order; the results are sorted by trial, then in the order of the laws.

    ``jobs`` and ``dask`` say where, as in :func:`~straightcomp_ros.offline.workers.spread`, with its errors;
    ``progress`` is called with the fraction that is done.
    """
    workers = jobs if jobs > 0 else os.cpu_count() or 1
    # At least one batch for each worker if there are enough trials.
    size = max(1, min(_LARGEST_BATCH, len(trials) // workers))
    batches = [trials[start : start + size] for start in range(0, len(trials), size)]
    finished = spread(run_trials, (scenario, seed), batches, jobs=jobs, dask=dask)
    results: list[TrialResult] = []
    progress(0.0)
    for batch in finished:
        results += batch
        progress(len(results) / (len(trials) * len(scenario.controls)))
    order = {law: place for place, law in enumerate(scenario.controls)}
    return sorted(results, key=lambda result: (result.trial, order[result.law]))


@dataclass(frozen=True)
class LawSummary:
    """The figures of one law over a sweep, trials that are not in order included."""

    law: str
    results: tuple[TrialResult, ...]

    def percentiles(self, figure: str) -> dict[str, float]:
        """Percentiles of a figure of `TrialResult` by their names; infinite where cycles broke off."""
        values = [getattr(one, figure) for one in self.results]
        # Interpolation between a number and infinity would be NaN.
        found = np.percentile(values, list(PERCENTILES.values()), method="inverted_cdf")
        return dict(zip(PERCENTILES, found.tolist(), strict=True))

    @property
    def trials(self) -> int:
        """Number of machines."""
        return len(self.results)

    @property
    def not_in_order(self) -> list[TrialResult]:
        """The trials that are not in order."""
        return [one for one in self.results if not one.verdict.in_order]

    @property
    def doubtful(self) -> set[str]:
        """Names of the percentiles of the peak-to-peak error that are the error of such a trial."""
        errors = {one.pp for one in self.not_in_order}
        return {name for name, value in self.percentiles("pp").items() if value in errors}

    @property
    def worst(self) -> TrialResult:
        """The trial with the largest peak-to-peak error."""
        return max(self.results, key=lambda one: one.pp)

    @property
    def verdicts(self) -> dict[str, int]:
        """Number of trials by the verdict's word, the most frequent first; only those that are not in order."""
        return dict(Counter(one.verdict.verdict for one in self.not_in_order).most_common())

    @property
    def verdict(self) -> Verdict:
        """The most frequent verdict that is not in order, with a machine as its example; in order if all are."""
        if not self.verdicts:
            return Verdict(IN_ORDER, f"all {self.trials} machines")
        word = next(iter(self.verdicts))
        example = next(one for one in self.not_in_order if one.verdict.verdict == word)
        counts = ", ".join(f"{name} {count}" for name, count in self.verdicts.items())
        return Verdict(word, f"{counts} of {self.trials} machines; machine {example.trial}: {example.verdict.reason}")

    def to_display(self) -> dict[str, Any]:
        """The figures with lengths in µm; infinite where a cycle broke off."""
        units = {"pp_um": 1e6, "rms_um": 1e6, "control_activity_A": 1.0, "control_rms_step_A": 1.0}
        return {
            **self.verdict._asdict(),
            **{
                name: {key: value * unit for key, value in self.percentiles(name.rpartition("_")[0]).items()}
                for name, unit in units.items()
            },
            "not_in_order": len(self.not_in_order),
            "verdicts": self.verdicts,
            "machines_not_in_order": [
                {"trial": one.trial, "pp_um": one.pp * 1e6, **one.verdict._asdict()} for one in self.not_in_order
            ],
            "worst_trial": self.worst.trial,
        }


def summarise(results: Iterable[TrialResult]) -> list[LawSummary]:
    """One summary for each law, in the order in which they first appear."""
    by_law: dict[str, list[TrialResult]] = {}
    for result in results:
        by_law.setdefault(result.law, []).append(result)
    return [LawSummary(law, tuple(trials)) for law, trials in by_law.items()]


def plot_sweep(summaries: Sequence[LawSummary], path: Path, title: str) -> None:
    """Draw the empirical distribution of each law's true peak-to-peak error.

    A curve ends below 100 % if cycles broke off. ``path`` (PNG, SVG or PDF) is replaced if it exists.
    """
    # The workers of a sweep need no matplotlib.
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter

    from straightcomp_ros.analysis.pictures import as_text, save_whole, show_grid

    figure = Figure(figsize=(8.0, 5.0), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    known = []
    looks = cycle(zip((BLUE, VERMILION, GREEN, GREY), ("-", "--", "-.", ":"), strict=True))
    for summary, (colour, style) in zip(summaries, looks, strict=False):
        errors_um = np.sort([one.pp * 1e6 for one in summary.results if math.isfinite(one.pp)])
        known += errors_um.tolist()
        # A step curve that starts at its foot, on the first value.
        x = np.concatenate([errors_um[:1], errors_um])
        fraction = np.arange(x.size) / summary.trials
        p50, p95 = (summary.percentiles("pp")[name] * 1e6 for name in ("p50", "p95"))
        errors = f"p50 {with_digits(p50, 2)} µm, p95 {with_digits(p95, 2)} µm"
        label = f"{summary.law}: {errors}, {len(summary.not_in_order)} not in order"
        axes.step(x, fraction, where="post", color=colour, linestyle=style, linewidth=1.6, label=label)
    if known and max(known) > _WIDE * min(known) > 0.0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("true compensation error, peak to peak / µm")
    axes.set_ylabel("fraction of the machines at or below")
    axes.set_title(as_text(title), fontsize=11)
    show_grid(axes)
    axes.margins(x=0.01)
    axes.legend(loc="lower right", fontsize=9)
    save_whole(figure, path)
