"""The pictures of a run (straightness, compensation error, control current) with what pictures share."""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import get_font_names

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.metrics import Metrics, straightness_over
from straightcomp_ros.analysis.record import StrokeRecord, group_means
from straightcomp_ros.analysis.style import BLACK, BLUE, GREY, GRID, PALE_BLUE, PALE_VERMILION, VERMILION
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.guide_map import StraightnessMap

_LENGTH_OF_MEAN_MM, _MEANS = 10.0, 50
"""Of the stage's travel that a point of the line is the mean of, and how many points the line has at least."""

# The names of users may be Chinese or Japanese, of which matplotlib's own font has no character.
_CHINESE_AND_JAPANESE = re.compile(r"CJK|Source Han|WenQuanYi|Droid Sans Fallback|IPA\w*Gothic")
rcParams["font.family"] = ["DejaVu Sans", *sorted(filter(_CHINESE_AND_JAPANESE.search, get_font_names()))]


def plot_run(record: StrokeRecord, straightness: StraightnessMap, metrics: Metrics, path: Path, title: str) -> None:
    """Draw ``record`` into the PNG ``path``, which is replaced if it exists.

    Straightness over x, before and after on one scale and after on its own; then over time the compensation error and
    the control current, motion shaded by direction. ``straightness`` is the map of the record's reference. MetricsError
    if the stage does not move in the record.
    """
    figure = Figure(figsize=(10.0, 9.5), dpi=150, layout="constrained")
    figure.suptitle(as_text(title), fontsize=13, wrap=True)
    rows = figure.add_gridspec(3, 2)
    both, after = figure.add_subplot(rows[0, 0]), figure.add_subplot(rows[0, 1])
    error = figure.add_subplot(rows[1, :])
    current = figure.add_subplot(rows[2, :], sharex=error)

    _straightness(both, after, record, straightness, metrics)
    for axes in (error, current):
        _shade(axes, record)
    plot_error(error, record, straightness, metrics)
    moving = record.moving
    _finish(error, "Compensation error r − y", "time / s", "error / µm", ncols=4)
    label = f"law {as_text(record.law)}: {metrics.control_rms_step * 1e3:.3g} mA RMS from sample to sample"
    current.plot(moving.time, moving.current * 1e3, color=BLACK, linewidth=0.6, label=label)
    _finish(current, "Control current", "time / s", "control current $i_c$ / mA", ncols=3)
    save_whole(figure, path)


def plot_error(axes: Axes, record: StrokeRecord, straightness: StraightnessMap, metrics: Metrics) -> None:
    """Draw the error of ``record`` in µm over the time of its motion, as the encoder has it, and the true one where it
    is known; ``straightness`` is the map of its reference, ``metrics`` its figures."""
    moving = record.moving
    truth = moving.true_error(straightness)
    for name, values, pp, rms, colour in (
        ("encoder", moving.r - moving.y, metrics.encoder_pp, metrics.encoder_rms, BLUE if truth is None else GREY),
        ("true", truth, metrics.true_pp, metrics.true_rms, BLUE),
    ):
        if values is not None and pp is not None and rms is not None:
            label = f"{name}: {with_digits(pp * 1e6, 2)} µm p-p, {with_digits(rms * 1e6, 3)} µm RMS"
            axes.plot(moving.time, values * 1e6, color=colour, linewidth=0.7, label=label)


def as_text(text: str) -> str:
    """A text that matplotlib draws as it is: names of users may have dollars, between which it reads mathematics, and
    bytes that are no UTF-8, which it does not draw."""
    return text.encode(errors="backslashreplace").decode().replace("$", r"\$")


def save_whole(figure: Figure, path: Path) -> None:
    """Save ``figure`` as the picture ``path``, whole or not at all; OSError or ValueError if it cannot be written,
    or has an ending that is no picture's."""
    drawn = BytesIO()
    figure.savefig(drawn, format=path.suffix[1:])
    write_whole(path, drawn.getvalue())


def _straightness(
    both: Axes, after: Axes, record: StrokeRecord, straightness: StraightnessMap, metrics: Metrics
) -> None:
    x, before, after_m = straightness_over(record, straightness)
    x_mm, before_um, after_um = x * 1e3, before * 1e6, after_m * 1e6
    length_mm = min(_LENGTH_OF_MEAN_MM, float(np.ptp(x_mm)) / _MEANS)
    forward = np.isin(record.motion.samples(), record.motion.samples("forward"))

    both.plot(x_mm, before_um, color=BLACK, label=f"before: {with_digits(metrics.uncompensated_pp * 1e6, 2)} µm p-p")
    both.plot(x_mm, after_um, color=BLUE, label=f"after: {with_digits(metrics.residual_pp * 1e6, 2)} µm p-p")
    for name, mask, colour, pale, style in (
        ("forward", forward, BLUE, PALE_BLUE, "-"),
        ("backward", ~forward, VERMILION, PALE_VERMILION, "--"),
    ):
        if mask.any():
            after.plot(x_mm[mask], after_um[mask], ".", color=pale, markersize=1.0, zorder=2)
            centres, means = group_means(x_mm[mask], after_um[mask], np.floor(x_mm[mask] / length_mm))
            label = f"{name}: {with_digits(float(np.ptp(after_um[mask])), 2)} µm p-p"
            after.plot(centres, means, color=colour, linestyle=style, linewidth=1.6, zorder=3, label=label)
    seen = "map + encoder" if record.guide is None else "true"
    enlarged = f"After, enlarged ({seen}; lines: mean over {length_mm:.2g} mm)"
    for axes, title in ((both, "Straightness before and after"), (after, enlarged)):
        _finish(axes, title, "slider position x / mm", "deviation / µm", ncols=2)


def _shade(axes: Axes, record: StrokeRecord) -> None:
    """Mark the strokes, each direction named once."""
    named: set[str] = set()
    for stroke in record.motion.strokes:
        colour = "#DCEBF5" if stroke.direction == "forward" else "#FBE9DD"
        label = None if stroke.direction in named else f"{stroke.direction} stroke"
        begin, end = record.time[stroke.start], record.time[stroke.stop - 1]
        axes.axvspan(begin, end, color=colour, linewidth=0.0, label=label, zorder=0)
        named.add(stroke.direction)


def _finish(axes: Axes, title: str, x: str, y: str, ncols: int) -> None:
    label(axes, title, x, y)
    axes.margins(x=0.01)
    legend_above(axes, ncols)


def label(axes: Axes, title: str, x: str, y: str) -> None:
    """Title, and what the axes show, as ``quantity / unit``; a pale grid behind the curves."""
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    show_grid(axes)


def legend_above(axes: Axes, ncols: int, fontsize: float = 8.0) -> None:
    """A legend at the top; the y axis is extended by a quarter, so that the legend covers no curve."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))
    axes.legend(loc="upper center", fontsize=fontsize, ncols=ncols)


def show_grid(axes: Axes) -> None:
    """Draw a pale grid behind the curves."""
    axes.grid(color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
