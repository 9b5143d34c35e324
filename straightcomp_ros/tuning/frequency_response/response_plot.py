"""Bode and Nyquist plots of a measured loop and its model."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from straightcomp_ros.analysis.pictures import as_text, save_whole
from straightcomp_ros.analysis.style import BLACK, BLUE, GREY, GRID, PALE_BLUE, VERMILION
from straightcomp_ros.tuning.frequency_response.measured_response import ComparedResponse

_REACH = 2.5
"""Half the width of the Nyquist plot: what happens near −1 matters."""


def plot_response(found: ComparedResponse, path: Path, title: str) -> None:
    """Save plant, open loop, sensitivity and coherence over the frequency, and Nyquist's plot.

    Bands are those of 95 % confidence. OSError or ValueError if ``path`` cannot be written, or has no picture's ending.
    """
    figure = Figure(figsize=(12.0, 9.0), dpi=150, layout="constrained")
    figure.suptitle(as_text(title), fontsize=13, wrap=True)
    grid = figure.add_gridspec(3, 3)
    gains = {}
    for place, name, scale, label in (
        ((0, 0), "plant", 1e6, "|P| / µm/A"),
        ((1, 0), "plant", None, "phase / °"),
        ((0, 1), "open_loop", 1.0, "|L| / 1"),
        ((1, 1), "open_loop", None, "phase / °"),
        ((2, 0), "sensitivity", 1.0, "|S|"),
    ):
        axes = gains[place] = figure.add_subplot(grid[place])
        if scale is None:
            _phase(axes, found, name)
        else:
            _magnitude(axes, found, name, scale)
        axes.set_ylabel(label)
    gains[0, 0].set_title("Plant P", fontsize=10)
    gains[0, 1].set_title("Open loop L", fontsize=10)
    coherence = figure.add_subplot(grid[2, 1])
    coherence.semilogx(found.measured.frequencies, found.measured.coherence, ".-", color=BLUE, linewidth=0.8)
    coherence.axhline(0.9, color=GREY, linewidth=0.8)
    coherence.set_ylim(0.0, 1.05)
    coherence.set_ylabel("coherence")
    for axes in (gains[2, 0], coherence):
        axes.set_xlabel("frequency / Hz")
    _nyquist(figure.add_subplot(grid[:, 2]), found)
    for axes in figure.axes:
        axes.grid(color=GRID, linewidth=0.5)
    save_whole(figure, path)


def _magnitude(axes: Axes, found: ComparedResponse, name: str, scale: float) -> None:
    frequencies, magnitude = found.measured.frequencies, np.abs(scale * getattr(found.measured.response, name))
    radius = scale * getattr(found.measured, f"{name}_radius")
    low = np.maximum(magnitude - radius, 1e-3 * magnitude)
    axes.fill_between(frequencies, low, magnitude + radius, color=PALE_BLUE)
    expected = np.abs(scale * getattr(found.model, name))
    axes.loglog(frequencies, expected, color=VERMILION, linewidth=1.0, label="model")
    axes.loglog(frequencies, magnitude, ".", color=BLUE, markersize=4.0, label="measured")
    for mode in found.mechanics.modes:
        axes.axvspan(mode.frequency.low, mode.frequency.high, color=GREY, alpha=0.3)
        axes.axvline(mode.frequency.value, color=GREY, linewidth=0.8, label=f"mode, {mode.frequency.value:.0f} Hz")
    axes.legend(fontsize=8)


def _phase(axes: Axes, found: ComparedResponse, name: str) -> None:
    frequencies, expected = found.measured.frequencies, getattr(found.model, name)
    model = np.degrees(np.unwrap(np.angle(expected)))
    if name == "open_loop":
        # The turn in which the phase margin is the distance from −180°, where the gain is 1.
        crossover = np.abs(np.log(np.abs(expected))).argmin()
        model -= 360.0 * np.round((model[crossover] + 180.0) / 360.0)
        axes.axhline(-180.0, color=GREY, linewidth=0.8)
    # Near the model, whichever turn the measured angle counts from.
    shown = model + np.degrees(np.angle(getattr(found.measured.response, name) / expected))
    axes.semilogx(frequencies, model, color=VERMILION, linewidth=1.0)
    axes.semilogx(frequencies, shown, ".", color=BLUE, markersize=4.0)


def _nyquist(axes: Axes, found: ComparedResponse) -> None:
    values, expected = found.measured.response.open_loop, found.model.open_loop
    circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 100))
    axes.plot(circle.real, circle.imag, color=GREY, linewidth=0.6)
    axes.plot(expected.real, expected.imag, color=VERMILION, linewidth=1.0, label="model")
    for around in values[:, None] + found.measured.open_loop_radius[:, None] * circle:
        axes.fill(around.real, around.imag, color=PALE_BLUE, alpha=0.6)
    axes.plot(values.real, values.imag, ".", color=BLUE, markersize=4.0, label="measured")
    axes.plot(-1.0, 0.0, "+", color=BLACK, markersize=10.0)
    axes.set_xlim(-_REACH, _REACH)
    axes.set_ylim(-_REACH, _REACH)
    axes.set_aspect("equal")
    axes.set_title("Open loop (Nyquist)", fontsize=10)
    axes.legend(fontsize=8)
