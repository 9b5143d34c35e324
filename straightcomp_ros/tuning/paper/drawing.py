"""What all pictures of the paper's figures share."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

GRID = "#D8D8D8"
SMALL = 8
"""Size in points of legends and remarks."""


def sheet(title: str, rows: int = 1, columns: int = 1, size: tuple[float, float] = (8.0, 5.0)) -> tuple[Figure, list]:
    """A figure with its title, and its axes row by row; ``size`` in inches."""
    return mosaic(title, np.arange(rows * columns).reshape(rows, columns).tolist(), size)


def mosaic(title: str, places: str | list, size: tuple[float, float]) -> tuple[Figure, list]:
    """A figure with its title, and its axes in the order of their first place, e.g. ``"ab;cc"``; size in inches."""
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12)
    return figure, list(figure.subplot_mosaic(places).values())


def label(axes: Axes, title: str, x: str, y: str) -> None:
    """Title, and what the axes show, as ``quantity / unit``; a grid behind the curves."""
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)


def legend_above(axes: Axes, columns: int = 2, room: float = 0.25) -> None:
    """A legend at the top; the y axis is extended by the fraction ``room``, so that it covers no curve."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + room * (high - low))
    axes.legend(loc="upper center", fontsize=SMALL, ncols=columns)
