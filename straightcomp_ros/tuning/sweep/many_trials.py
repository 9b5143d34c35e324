"""Many trials, on this machine's cores by joblib or on others by Dask, with the same numbers; their figures, and the
picture of them: the fraction of the machines at or below an error, for each law."""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis.judgement import IN_ORDER, Verdict
from straightcomp_ros.offline.scenario import Scenario, laws_of
from straightcomp_ros.offline.workers import spread
from straightcomp_ros.tuning.sweep.trial import TrialResult, run_trial

_LARGEST_BATCH = 10
"""Trials in a batch: two seconds of work, for frequent progress at little cost of sending."""
PERCENTILES = {"p5": 5.0, "p50": 50.0, "p95": 95.0, "max": 100.0}
"""Percentiles of a distribution, by name. Each is the value of a trial: nothing is interpolated."""
# Okabe and Ito's palette without its yellow; styles distinguish the curves on a black-and-white print.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
_STYLES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
_WIDE = 8.0
"""Ratio of largest to smallest error from which the axis is logarithmic."""
OUTLIER = 2.0
"""A trial is an outlier above this multiple of the median peak-to-peak error."""


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

    Args:
        scenario: what the trials have in common.
        seed: of all random numbers.
        trials: their numbers, each from 0.
        jobs: processes on this machine; −1 takes all cores. Not used with ``dask``.
        dask: address of a Dask scheduler, whose workers have this package; empty stays on this machine.
        progress: called with the fraction that is done.

    Raises:
        WorkersError: Dask is not installed, or its scheduler or workers cannot be reached.
    """
    workers = jobs if jobs > 0 else os.cpu_count() or 1
    batches = _batches(trials, workers)
    finished = spread(run_trials, (scenario, seed), batches, jobs=jobs, dask=dask)
    results: list[TrialResult] = []
    progress(0.0)
    for batch in finished:
        results += batch
        progress(len(results) / (len(trials) * len(scenario.controls)))
    order = {law: place for place, law in enumerate(scenario.controls)}
    return sorted(results, key=lambda result: (result.trial, order[result.law]))


def _batches(trials: Sequence[int], workers: int) -> list[Sequence[int]]:
    """Batches of the trials, at least one for each worker if there are enough of them."""
    size = max(1, min(_LARGEST_BATCH, len(trials) // workers))
    return [trials[start : start + size] for start in range(0, len(trials), size)]


@dataclass(frozen=True)
class LawSummary:
    """The figures of one law over a sweep, trials that are not in order included.

    Attributes:
        law: its name.
        trials: number of machines.
        pp, rms: percentiles of the true compensation error by name, m; infinite where cycles broke off.
        control_activity: percentiles of Σ |Δ i_c|, A.
        control_rms_step: percentiles of the root mean square of Δ i_c, A.
        verdicts: number of trials by the verdict's word, the most frequent first; only those that are not in order.
        not_in_order: those trials, in their order.
        doubtful: names of the percentiles of ``pp`` that are the error of such a trial.
        worst_trial: number of the trial with the largest peak-to-peak error.
        outliers: peak-to-peak error in m of each trial in which it is above `OUTLIER` medians, by trial, worst first.
    """

    law: str
    trials: int
    pp: dict[str, float]
    rms: dict[str, float]
    control_activity: dict[str, float]
    control_rms_step: dict[str, float]
    verdicts: dict[str, int]
    not_in_order: tuple[TrialResult, ...]
    doubtful: frozenset[str]
    worst_trial: int
    outliers: dict[int, float]

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
        """The figures with lengths in µm; None where they are infinite."""
        return {
            **self.verdict._asdict(),
            "pp_um": _shown(self.pp, 1e6),
            "rms_um": _shown(self.rms, 1e6),
            "control_activity_A": _shown(self.control_activity, 1.0),
            "control_rms_step_A": _shown(self.control_rms_step, 1.0),
            "not_in_order": len(self.not_in_order),
            "verdicts": self.verdicts,
            "machines_not_in_order": [
                {"trial": one.trial, "pp_um": one.pp * 1e6 if math.isfinite(one.pp) else None, **one.verdict._asdict()}
                for one in self.not_in_order
            ],
            "worst_trial": self.worst_trial,
            "outliers": [
                {"trial": trial, "pp_um": pp * 1e6 if math.isfinite(pp) else None}
                for trial, pp in self.outliers.items()
            ],
        }


def summarise(results: Iterable[TrialResult]) -> list[LawSummary]:
    """One summary for each law, in the order in which they first appear."""
    by_law: dict[str, list[TrialResult]] = {}
    for result in results:
        by_law.setdefault(result.law, []).append(result)
    return [_summary(law, trials) for law, trials in by_law.items()]


def _summary(law: str, trials: Sequence[TrialResult]) -> LawSummary:
    pp = _percentiles([trial.pp for trial in trials])
    bad = tuple(trial for trial in trials if not trial.verdict.in_order)
    errors = {trial.pp for trial in bad}
    return LawSummary(
        law=law,
        trials=len(trials),
        pp=pp,
        rms=_percentiles([trial.rms for trial in trials]),
        control_activity=_percentiles([trial.control_activity for trial in trials]),
        control_rms_step=_percentiles([trial.control_rms_step for trial in trials]),
        verdicts=dict(Counter(trial.verdict.verdict for trial in bad).most_common()),
        not_in_order=bad,
        # Each percentile is the value of a trial.
        doubtful=frozenset(name for name, value in pp.items() if value in errors),
        worst_trial=max(trials, key=lambda trial: trial.pp).trial,
        outliers=_outliers(trials),
    )


def _outliers(trials: Sequence[TrialResult]) -> dict[int, float]:
    limit = OUTLIER * _percentiles([trial.pp for trial in trials])["p50"]
    worse = [trial for trial in trials if trial.pp > limit]
    return {trial.trial: trial.pp for trial in sorted(worse, key=lambda trial: -trial.pp)}


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    # Interpolation between a number and infinity would be NaN.
    found = np.percentile(values, list(PERCENTILES.values()), method="inverted_cdf")
    return dict(zip(PERCENTILES, found.tolist(), strict=True))


def _shown(percentiles: dict[str, float], unit: float) -> dict[str, float | None]:
    return {name: value * unit if math.isfinite(value) else None for name, value in percentiles.items()}


def plot_sweep(results: Sequence[TrialResult], summaries: Sequence[LawSummary], path: str | Path, title: str) -> Path:
    """Draw the empirical distribution of each law's true peak-to-peak error, and return the path.

    A curve ends below 100 % if cycles broke off.

    Args:
        results: of the sweep.
        summaries: of the same sweep, for the legend.
        path: the picture (PNG, SVG or PDF), replaced if it exists.
        title: of the picture.
    """
    # The workers of a sweep need no matplotlib.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter

    from straightcomp_ros.analysis.pictures import as_text, save_whole

    figure = Figure(figsize=(8.0, 5.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    finite = np.sort([result.pp * 1e6 for result in results if math.isfinite(result.pp)])
    for summary, colour, style in zip(summaries, cycle(_COLOURS), cycle(_STYLES), strict=False):
        errors_um = np.sort([one.pp * 1e6 for one in results if one.law == summary.law and math.isfinite(one.pp)])
        # A step curve that starts at its foot, on the first value.
        x = np.concatenate([errors_um[:1], errors_um])
        fraction = np.arange(x.size) / summary.trials
        p50, p95 = summary.pp["p50"] * 1e6, summary.pp["p95"] * 1e6
        label = f"{summary.law}: p50 {p50:.2f} µm, p95 {p95:.2f} µm, {len(summary.not_in_order)} not in order"
        axes.step(x, fraction, where="post", color=colour, linestyle=style, linewidth=1.6, label=label)
    if finite.size and finite[-1] > _WIDE * finite[0] > 0.0:
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
    axes.grid(color="#D8D8D8", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.legend(loc="lower right", fontsize=9)
    save_whole(figure, Path(path))
    return Path(path)
