"""What every figure of the paper has: numbers to compare with the paper's, and a sheet to draw on."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

SMALL = 8
"""Size in points of legends and remarks."""


@dataclass(frozen=True)
class Claim:
    """One number, as computed here and as printed."""

    name: str  # what the number is, in words
    ours: float  # our number; NaN where there is none. Of a stroke it is the median over several starts
    unit: str  # of both; empty for pure numbers
    note: str  # what to know of it
    paper: float | None = None  # the paper's number, None where it prints none
    tolerance: float = 0.0  # largest |ours − paper| that counts as agreement; no meaning without ``paper``
    range: tuple[float, float] | None = None  # least and largest over the starts; None for what does not depend on one

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
        ours = self.ours if math.isfinite(self.ours) else None
        tolerance = None if self.paper is None else self.tolerance
        return {**vars(self), "ours": ours, "tolerance": tolerance, "within": self.within}


class PaperFigure(NamedTuple):
    """A figure that was computed: its numbers, and its picture."""

    claims: Iterable[Claim]
    picture: Figure


def legend_below(figure: Figure, *entries: Any, **looks: Any) -> None:
    """Put ``figure.legend(*entries, **looks)`` below all axes of a :func:`sheet`; as "outside lower center" does, which
    is new in matplotlib 3.7."""
    top = figure.legend(*entries, loc="lower center", **looks).get_window_extent().y1 / figure.bbox.height
    figure.set_layout_engine("constrained", rect=(0.0, top, 1.0, 1.0 - top))


def sheet(title: str, places: str, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """A figure with its title, and its axes in the order of their first place, e.g. ``"ab;cc"``; size in inches."""
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    figure.suptitle(title, fontsize=12)
    return figure, list(figure.subplot_mosaic(places).values())
