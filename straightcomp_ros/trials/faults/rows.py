"""What a trial of faults found: how often, how fast, and whether that is fast enough."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Row:
    """One fault.

    Attributes:
        name: of the fault and how it was made.
        limit_ms: within which it must be latched.
        reaction, reset: in words.
        injected: times that it was made.
        times_ms: of each detection.
        failures: what was not as it must be, each time that something was not.
    """

    name: str
    limit_ms: float
    reaction: str
    reset: str
    injected: int = 0
    times_ms: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    @property
    def green(self) -> bool:
        """Detected each time, in time, with all that follows as it must."""
        return (
            self.injected > 0
            and len(self.times_ms) == self.injected
            and max(self.times_ms) <= self.limit_ms
            and not self.failures
        )

    def to_display(self) -> dict[str, Any]:
        """Values by name, as `straightcomp faults --json` prints them."""
        times = self.times_ms or [math.nan]
        return {
            "name": self.name,
            "injected": self.injected,
            "detected": len(self.times_ms),
            "median_ms": statistics.median(times),
            "max_ms": max(times),
            "limit_ms": self.limit_ms,
            "green": self.green,
            "reaction": self.reaction,
            "reset": self.reset,
            "failures": self.failures,
        }


def summary(rows: Sequence[Row], seconds: float) -> dict[str, Any]:
    """All rows, whether all are green, and how long it took in s."""
    return {
        "faults": [row.to_display() for row in rows],
        "all_green": bool(rows) and all(row.green for row in rows),
        "seconds": seconds,
    }
