"""Result of a fault trial: how often and how fast the fault was detected, and whether that is fast enough."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Row:
    """Result for one fault.

    Attributes:
        name: of the fault and how it was caused.
        limit_ms: the fault must be latched within this time.
        reaction, reset: in words.
        injected: number of injections.
        times_ms: of each detection.
        failures: in words, one entry for each failure of an injection.
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
        """Whether each injection was detected in time, with all reactions as they must be."""
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
    """All rows, whether all are green, and the duration in s."""
    return {
        "faults": [row.to_display() for row in rows],
        "all_green": bool(rows) and all(row.green for row in rows),
        "seconds": seconds,
    }
