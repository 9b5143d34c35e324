"""Bode and Nyquist plots of a measured loop and its model."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from straightcomp_ros.analysis.pictures import BLACK, BLUE, GREY, PALE_BLUE, VERMILION, as_text, save_whole
from straightcomp_ros.tuning.frequency_response.measured_response import ComparedResponse

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_REACH = 2.5
"""Half the width of the Nyquist plot: what happens near −1 matters."""


def plot_response(found: ComparedResponse, path: Path, title: str) -> None:
    """Save plant, open loop, sensitivity and coherence over the frequency, and Nyquist's plot.

    Bands are those of 95 % confidence. OSError or ValueError if ``path`` cannot be written, or has no picture's ending.
    """
    figure = Figure(figsize=(12.0, 9.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(as_text(title), fontsize=13)
    grid = figure.add_gridspec(3, 3)
    measured, model = found.measured, found.model
    columns = (
        ("Plant P", "µm/A", 1e6, measured.response.plant, measured.plant_radius, model.plant),
        ("Open loop L", "1", 1.0, measured.response.open_loop, measured.open_loop_radius, model.open_loop),
    )
    for column, (name, unit, scale, values, radius, expected) in enumerate(columns):
        gain, phase = figure.add_subplot(grid[0, column]), figure.add_subplot(grid[1, column])
        _magnitude(
            gain, measured.frequencies, scale * values, scale * radius, scale * expected, f"|{name[-1]}| / {unit}"
        )
        gain.set_title(name, fontsize=10)
        _phase(phase, measured.frequencies, values, expected)
    sensitivity = figure.add_subplot(grid[2, 0])
    response = measured.response.sensitivity
    _magnitude(sensitivity, measured.frequencies, response, measured.sensitivity_radius, model.sensitivity, "|S|")
    coherence = figure.add_subplot(grid[2, 1])
    coherence.semilogx(measured.frequencies, measured.coherence, ".-", color=BLUE, linewidth=0.8)
    coherence.axhline(0.9, color=GREY, linewidth=0.8)
    coherence.set_ylim(0.0, 1.05)
    coherence.set_ylabel("coherence")
    for axes in (sensitivity, coherence):
        axes.set_xlabel("frequency / Hz")
        axes.grid(color="#D8D8D8", linewidth=0.5)
    _nyquist(figure.add_subplot(grid[:, 2]), measured.response.open_loop, measured.open_loop_radius, model.open_loop)
    save_whole(figure, path)


def _magnitude(axes: Axes, frequencies: Array, values: Complex, radius: Array, expected: Complex, label: str) -> None:
    magnitude = np.abs(values)
    axes.fill_between(
        frequencies, np.maximum(magnitude - radius, 1e-3 * magnitude), magnitude + radius, color=PALE_BLUE
    )
    axes.loglog(frequencies, np.abs(expected), color=VERMILION, linewidth=1.0, label="model")
    axes.loglog(frequencies, magnitude, ".", color=BLUE, markersize=4.0, label="measured")
    axes.set_ylabel(label)
    axes.grid(color="#D8D8D8", linewidth=0.5)
    axes.legend(fontsize=8)


def _phase(axes: Axes, frequencies: Array, values: Complex, expected: Complex) -> None:
    model = np.degrees(np.unwrap(np.angle(expected)))
    # Beside the model, whichever turn the measured angle counts from.
    shown = model + np.degrees(np.angle(values / expected))
    axes.semilogx(frequencies, model, color=VERMILION, linewidth=1.0)
    axes.semilogx(frequencies, shown, ".", color=BLUE, markersize=4.0)
    axes.set_ylabel("phase / °")
    axes.grid(color="#D8D8D8", linewidth=0.5)


def _nyquist(axes: Axes, values: Complex, radius: Array, expected: Complex) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 100)
    axes.plot(np.cos(angles), np.sin(angles), color=GREY, linewidth=0.6)
    axes.plot(expected.real, expected.imag, color=VERMILION, linewidth=1.0, label="model")
    for value, width in zip(values, radius, strict=True):
        circle = value + width * np.exp(1j * angles)
        axes.fill(circle.real, circle.imag, color=PALE_BLUE, alpha=0.6)
    axes.plot(values.real, values.imag, ".", color=BLUE, markersize=4.0, label="measured")
    axes.plot(-1.0, 0.0, "+", color=BLACK, markersize=10.0)
    axes.set_xlim(-_REACH, _REACH)
    axes.set_ylim(-_REACH, _REACH)
    axes.set_aspect("equal")
    axes.set_title("Open loop (Nyquist)", fontsize=10)
    axes.grid(color="#D8D8D8", linewidth=0.5)
    axes.legend(fontsize=8)
