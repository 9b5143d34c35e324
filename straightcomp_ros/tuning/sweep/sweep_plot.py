"""The picture of a sweep: the fraction of the machines at or below an error, for each law."""

import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter

from straightcomp_ros.analysis.pictures import as_text, save_whole
from straightcomp_ros.tuning.sweep.many_trials import LawSummary
from straightcomp_ros.tuning.sweep.trial import TrialResult

# Okabe and Ito's palette without its yellow; styles tell the curves apart on a black-and-white print.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
_STYLES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
_WIDE = 8.0
"""Ratio of largest to smallest error from which the axis is logarithmic."""


def plot_sweep(results: Sequence[TrialResult], summaries: Sequence[LawSummary], path: str | Path, title: str) -> Path:
    """Draw the empirical distribution of each law's true peak-to-peak error, and return the path.

    A curve ends below 100 % if cycles broke off.

    Args:
        results: of the sweep.
        summaries: of the same sweep, for the legend.
        path: the picture (PNG, SVG or PDF), replaced if it exists.
        title: of the picture.
    """
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
