"""The picture of a sweep: which part of the machines stays below which error, for each law."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter

from straightcomp_ros.offline.sweep.sweep_summary import LawSummary
from straightcomp_ros.offline.sweep.trial import TrialResult

# Okabe and Ito's palette without its yellow; styles tell the curves apart on a black-and-white print.
_CURVES = (
    ("#0072B2", "-"),
    ("#D55E00", "--"),
    ("#009E73", "-."),
    ("#CC79A7", (0, (1, 1))),
    ("#56B4E9", (0, (5, 1, 1, 1, 1, 1))),
    ("#000000", (0, (8, 2))),
)
_WIDE = 8.0
"""Ratio of largest to smallest error from which the axis is logarithmic."""


def plot_sweep(results: Sequence[TrialResult], summaries: Sequence[LawSummary], path: str | Path, title: str) -> Path:
    """Draw the empirical distribution of the true peak-to-peak error of each law into one PNG.

    A curve ends below 100 % where cycles broke off.

    Args:
        results: of the sweep.
        summaries: of the same, for the legend.
        path: the PNG, replaced if it exists.
        title: stands over the picture.

    Returns:
        The path.
    """
    figure = Figure(figsize=(8.0, 5.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    errors_um = {
        summary.law: np.sort([result.pp * 1e6 for result in results if result.law == summary.law])
        for summary in summaries
    }
    for place, summary in enumerate(summaries):
        colour, style = _CURVES[place % len(_CURVES)]
        values = errors_um[summary.law]
        ended = values[np.isfinite(values)]
        # A step curve that starts at its foot, on the first value.
        x = np.concatenate([ended[:1], ended])
        part = np.arange(x.size) / values.size
        p50, p95 = summary.pp["p50"] * 1e6, summary.pp["p95"] * 1e6
        label = f"{summary.law}: p50 {p50:.2f} µm, p95 {p95:.2f} µm, {summary.limit_cycles} limit cycles"
        axes.step(x, part, where="post", color=colour, linestyle=style, linewidth=1.6, label=label)
    everything = np.concatenate(list(errors_um.values()))
    everything = everything[np.isfinite(everything)]
    if everything.size and everything.max() > _WIDE * everything.min() > 0.0:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel("true compensation error, peak to peak / µm")
    axes.set_ylabel("part of the machines at or below")
    axes.set_title(title, fontsize=11)
    axes.grid(color="#D8D8D8", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.legend(loc="lower right", fontsize=9)
    path = Path(path)
    figure.savefig(path)
    return path
