"""The page of a map, one sheet of A4 to be signed: the survey with its runs, means and outliers, what the runs and the
smoothing leave, and the figures with their uncertainties."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.map_building import BuiltMap
from straightcomp_ros.analysis.pictures import as_text, legend_above, save_whole, show_grid
from straightcomp_ros.analysis.straightness_statement import COVERAGE_FACTOR
from straightcomp_ros.analysis.style import BLACK, BLUE, GREY, PALE_BLUE, PALE_VERMILION, SOFT, VERMILION
from straightcomp_ros.bags.information import origin
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.smoothing import NORMAL_95
from straightcomp_ros.straightness.survey import Run
from straightcomp_ros.straightness.survey_header import Direction
from straightcomp_ros.straightness.survey_table import MARK

_POINTS = 2000
_LONGEST, _LINES = 54, 3
"""Characters in a line of a fact, for half of the sheet, and the most lines of one."""
_WAYS = (("forward", BLUE, PALE_BLUE, "-"), ("backward", VERMILION, PALE_VERMILION, "--"))

_TABLES: tuple[tuple[Direction, str], ...] = (("forward", "-"), ("backward", ":"))
"""Styles of the two tables of a map."""


def plot_map(built: BuiltMap, path: Path, machine: str = "") -> None:
    """Draw the sheet of ``built``, of the ``machine`` of this name.

    The panels: runs, means and map, with rejected runs and points; the runs relative to the mean, with the bands of
    ± 2 s; the mean relative to the map, which is what smoothing took off, with the map's own bands of 1 s and 95 %.

    OSError or ValueError if the picture ``path`` cannot be written, or has an ending that is no picture's.
    """
    figure = Figure(figsize=(8.27, 11.69), dpi=150)
    figure.subplots_adjust(left=0.09, right=0.96, bottom=0.1, top=0.705, hspace=0.33)
    title = f"Map of the guide of {machine}" if machine else "Map of the guide"
    figure.text(0.06, 0.96, as_text(title), fontsize=15, weight="bold")
    columns = ((0.06, _origin(built, machine)), (0.53, _figures(built)))
    for left, facts in columns:
        height = 0.94
        for name, text in facts:
            figure.text(left, height, name, fontsize=6.5, color=SOFT)
            for line in textwrap.wrap(text, _LONGEST, max_lines=_LINES, placeholder=" …") or [""]:
                figure.text(left + 0.115, height, as_text(line), fontsize=6.5)
                height -= 0.0145
    for name, left, right in (("Measured by", 0.06, 0.36), ("Date", 0.40, 0.58), ("Signature", 0.62, 0.94)):
        figure.text(left, 0.035, name, fontsize=8, color=SOFT)
        figure.add_artist(Line2D([left + 0.012 * len(name), right], [0.034, 0.034], color=BLACK, linewidth=0.6))
    for draw, axes in zip((_survey, _runs, _smoothing), figure.subplots(3, 1, sharex=True), strict=True):
        draw(axes, built)
        axes.set_xlabel("slider position x / mm", fontsize=8)
        axes.set_ylabel("deviation / µm", fontsize=8)
        axes.tick_params(labelsize=7, labelbottom=True)
        show_grid(axes)
        axes.margins(x=0.01)
        legend_above(axes, ncols=5, fontsize=6.5)
    save_whole(figure, path)


def _origin(built: BuiltMap, machine: str) -> Iterator[tuple[str, str]]:
    """Where the map comes from, in words."""
    facts, by = built.provenance, origin()
    yield "machine", machine or facts.get("machine", "not stated")
    for name in ("instrument", "measured", "operator", MARK):
        yield name, facts.get(name, "not stated")
    yield "survey", facts.get("source", Path(built.straightness.survey.source).name)
    yield "made by", facts.get("made by", "not stated").removeprefix("straightcomp ")
    yield "this page", f"{by['package']} {by['version']}, {datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"
    yield "choices", facts.get("choices", "not stated")
    yield "units", f"x in mm, deviation in µm; U with k = {COVERAGE_FACTOR:g}; band of 95 %: k = {NORMAL_95:g}"


def _figures(built: BuiltMap) -> Iterator[tuple[str, str]]:
    """The figures, in words."""
    figures, found, noise = built.figures(), built.straightness.report, built.straightness.noise
    runs = [one.runs if one else 0 for one in (found.forward, found.backward)]
    yield "runs", f"{runs[0]} forward, {runs[1]} backward"
    steps = np.diff(found.x) * 1e3
    unequal = f" ({steps.min():.4g} to {steps.max():.4g})" if np.ptp(steps) > 0.01 else ""
    spacing = f"{np.median(steps):.4g} mm{unequal}"
    # The map's file says it: of one that was made before, nothing is rejected any more.
    stated = built.provenance.get("runs", "").partition("; rejected runs: ")[2]
    lost_runs, _, lost_points = stated.rpartition("; rejected points: ")
    yield "rejected runs", lost_runs or "not stated"
    yield "points", f"{len(found.x)}, spacing {spacing}; rejected: {lost_points or 'not stated'}"
    yield "x", f"{figures['first_mm']:.6g} to {figures['last_mm']:.6g} mm"
    for one in built.statements:
        value, uncertainty = one.value * 1e6, one.expanded_uncertainty * 1e6
        yield one.line.replace("_", " "), f"{value:.3f} µm ± {uncertainty:.2g} µm (ISO 230-1, map, U)"
    for name in ("forward", "backward", "bidirectional"):
        value = figures[f"repeatability_{name}_um"]
        yield f"R {name}", "unknown" if value is None else f"{with_digits(value, 3)} µm (ISO 230-2, k = 2)"
    largest, average = (figures[f"reversal_{name}_um"] for name in ("max", "mean"))
    yield (
        "reversal",
        "unknown" if largest is None else f"{with_digits(largest, 3)} µm at most, mean {with_digits(average, 3)} µm",
    )
    yield (
        "noise of mean",
        f"{with_digits(noise.point * 1e6, 3)} µm (1 s)" + ("" if noise.repeated else ", of the residual"),
    )
    yield "band of map", f"± {noise.half_width * 1e6:.2g} µm (95 %, RMS over x)"


def _survey(axes: Axes, built: BuiltMap) -> None:
    found = built.straightness.report
    for name, colour, pale, style in _WAYS:
        directed = getattr(found, name)
        for run in built.straightness.survey.in_direction(name):  # type: ignore[arg-type]
            axes.plot(run.x * 1e3, run.deviation * 1e6, color=pale, linewidth=0.7)
        if directed is not None:
            label = f"{name}, mean of {directed.runs}"
            axes.plot(found.x * 1e3, directed.mean * 1e6, style, color=colour, linewidth=0.9, label=label)
    x = np.linspace(*built.straightness.span, _POINTS)
    for way, style in _TABLES if built.straightness.directed else ((None, "-"),):
        label = f"map, {way}" if way else "map"
        axes.plot(x * 1e3, built.straightness.deviations(x, way) * 1e6, style, color=BLACK, linewidth=0.6, label=label)
    _rejected(axes, built, np.zeros_like(found.x))
    axes.set_title(f"Survey of the guide: {peak_to_peak(found.mean) * 1e6:.2f} µm peak to peak", fontsize=9)


def _runs(axes: Axes, built: BuiltMap) -> None:
    found = built.straightness.report
    x_mm, mean = found.x * 1e3, found.mean
    for name, colour, pale, style in _WAYS:
        directed = getattr(found, name)
        if directed is None:
            continue
        for run in built.straightness.survey.in_direction(name):  # type: ignore[arg-type]
            apart = run.deviation - np.interp(run.x, found.x, mean)
            axes.plot(run.x * 1e3, apart * 1e6, ".", color=pale, markersize=1.5)
        apart = (directed.mean - mean) * 1e6
        axes.plot(x_mm, apart, style, color=colour, linewidth=0.9, label=f"{name}, mean")
        if directed.s is not None:
            band = 2e6 * directed.s
            axes.fill_between(x_mm, apart - band, apart + band, color=pale, alpha=0.35, label=f"{name} ± 2 s")
    if built.straightness.directed:
        for way, style in _TABLES:
            apart = (built.straightness.deviations(found.x, way) - mean) * 1e6
            axes.plot(x_mm, apart, style, color=BLACK, linewidth=0.6, label=f"map, {way}")
    _rejected(axes, built, mean)
    axes.set_title("Runs relative to the mean of both directions", fontsize=9)


def _rejected(axes: Axes, built: BuiltMap, mean: NDArray[np.float64]) -> None:
    """The runs and points that were left out, relative to ``mean`` over the map's x in m."""
    at, (low, high) = built.straightness.report.x, axes.get_ylim()

    def apart(run: Run, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.interp(x, run.x, run.deviation) - np.interp(x, at, mean)) * 1e6

    runs = {f"{run.name} {run.direction}": run for run in built.measured.runs}
    for number, name in enumerate(built.rejected_runs):
        x = runs[name].x
        label = "rejected run" if number == 0 else None
        axes.plot(x * 1e3, apart(runs[name], x), ":", color=GREY, linewidth=0.9, label=label)
    for number, (name, point) in enumerate(built.rejected_points):
        x = np.array([point])
        label = "rejected point" if number == 0 else None
        axes.plot(x * 1e3, apart(runs[name], x), "x", color=BLACK, markersize=4.0, linewidth=0.8, label=label)
    # A run that came loose must not squeeze the others.
    room = 0.5 * (high - low)
    axes.set_ylim(*np.clip(axes.get_ylim(), low - room, high + room))


def _smoothing(axes: Axes, built: BuiltMap) -> None:
    x, noise = built.straightness.report.x, built.straightness.noise
    band, off = noise.band(x) * 1e6, (built.straightness.report.mean - built.straightness.deviations(x)) * 1e6
    for factor, shade, name in ((NORMAL_95, 0.25, "map, 95 %"), (1.0, 0.5, "map, 1 s")):
        axes.fill_between(x * 1e3, -factor * band, factor * band, color=GREY, alpha=shade, linewidth=0.0, label=name)
    axes.plot(x * 1e3, off, ".", color=BLUE, markersize=2.5, zorder=1, label="mean of the runs")
    taken = f"{peak_to_peak(off):.3g} µm peak to peak" if noise.smoothed else "nothing: the map goes through every mean"
    axes.set_title(f"Mean relative to the map; smoothing took off {taken}", fontsize=9)
