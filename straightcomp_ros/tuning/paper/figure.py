"""What every figure of the paper has: numbers to compare with the paper's, and a sheet to draw on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

GRID = "#D8D8D8"
SMALL = 8
"""Size in points of legends and remarks."""


@dataclass(frozen=True)
class Claim:
    """One number, as printed and as computed here.

    Attributes:
        name: what the number is, in words.
        paper: the paper's number, None where it prints none.
        ours: our number; NaN where there is none. Of a stroke it is the median over several starts.
        unit: of both; empty for pure numbers.
        tolerance: largest |ours − paper| that counts as agreement; no meaning without ``paper``.
        note: what to know of it.
        range: least and largest over the starts; None for what does not depend on one.
    """

    name: str
    paper: float | None
    ours: float
    unit: str = ""
    tolerance: float = 0.0
    note: str = ""
    range: tuple[float, float] | None = None

    @property
    def shown(self) -> str:
        """Our number in four digits, with its range."""
        if self.range is None:
            return f"{self.ours:.4g}"
        return "{:.3g} ({:.3g} to {:.3g})".format(self.ours, *self.range)

    @property
    def within(self) -> bool | None:
        """Whether ours agrees with the paper's; None where the paper prints no number."""
        return None if self.paper is None else abs(self.ours - self.paper) <= self.tolerance

    def to_display(self) -> dict[str, Any]:
        """The claim as JSON can say it: what is not finite becomes None."""
        return {
            "name": self.name,
            "paper": self.paper,
            "ours": self.ours if math.isfinite(self.ours) else None,
            "range": self.range,
            "unit": self.unit,
            "tolerance": self.tolerance if self.paper is not None else None,
            "within": self.within,
            "note": self.note,
        }


class PaperFigure(Protocol):
    """A figure that was computed."""

    @property
    def claims(self) -> Sequence[Claim]:
        """Its numbers."""
        ...

    def draw(self) -> Figure:
        """Its picture."""
        ...


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
