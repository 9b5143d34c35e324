"""A number of the paper beside ours."""

import math
from dataclasses import dataclass
from typing import Any


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
    unit: str
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


def yes(fact: bool) -> float:
    """A fact as the number of a claim: 1 if it holds, 0 if not."""
    return 1.0 if fact else 0.0
