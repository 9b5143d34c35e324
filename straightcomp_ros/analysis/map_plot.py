"""The picture of a survey: the runs, their mean, and the difference between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from straightcomp_ros.analysis.map_building import BuiltMap
from straightcomp_ros.analysis.run_plot import BLACK, BLUE, GREY, PALE_BLUE, PALE_VERMILION, VERMILION, show_grid


def plot_map(built: BuiltMap, path: Path) -> None:
    """Draw the map over its runs, and below on their own scale the runs beside the mean, with the band of ± 2 s.

    Raises:
        OSError, ValueError: the picture ``path`` cannot be written, or has an ending that is no picture's.
    """
    figure = Figure(figsize=(10.0, 8.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    figures, found, mean = built.figures(), built.repeatability, built.mean
    x_mm = found.x * 1e3
    for run in built.survey.runs:
        pale = PALE_BLUE if run.direction == "forward" else PALE_VERMILION
        upper.plot(run.x * 1e3, run.deviation * 1e6, color=pale, linewidth=0.8)
        beside = run.deviation - np.interp(run.x, found.x, mean)
        lower.plot(run.x * 1e3, beside * 1e6, ".", color=pale, markersize=2.0)
    label = f"mean: {figures['straightness_least_squares_um']:.2f} µm p-p beside its least squares line"
    upper.plot(x_mm, mean * 1e6, color=BLACK, linewidth=1.2, label=label)
    ways = ((found.forward, "forward", BLUE, PALE_BLUE), (found.backward, "backward", VERMILION, PALE_VERMILION))
    for directed, name, colour, pale in ways:
        if directed is None:
            continue
        beside = (directed.mean - mean) * 1e6
        lower.plot(x_mm, beside, color=colour, linewidth=1.2, label=f"{name}, mean of {directed.runs}")
        if directed.s is not None:
            band = 2e6 * directed.s
            lower.fill_between(x_mm, beside - band, beside + band, color=pale, alpha=0.35, label=f"{name} ± 2 s")
    for _, x in built.rejected_points:
        lower.axvline(x * 1e3, color=GREY, linewidth=0.6)
    r = figures["repeatability_bidirectional_um"]
    lower.set_title("Runs beside the mean" + ("" if r is None else f"; R = {r:.3f} µm (ISO 230-2)"), fontsize=10)
    upper.set_title("Survey of the guide", fontsize=10)
    lower.set_xlabel("slider position x / mm")
    for axes in (upper, lower):
        axes.set_ylabel("deviation / µm")
        show_grid(axes)
        axes.legend(fontsize=8, ncols=2)
    figure.savefig(path)
