"""The words of a verdict on a run. They are stable: programs compare them."""

from collections.abc import Sequence
from typing import NamedTuple

WORDS = (
    *("in_order", "clock_jumped", "interrupted", "starved", "at_stop"),
    *("left_map", "saturated", "wrong_guide", "mains", "locked_to_x", "stick_slip", "resonance"),
    *("vibration", "oscillates", "inaccurate"),
)
IN_ORDER, CLOCK_JUMPED, INTERRUPTED, STARVED, AT_STOP, LEFT_MAP, SATURATED, WRONG_GUIDE = WORDS[:8]
MAINS, LOCKED_TO_X, STICK_SLIP, RESONANCE, VIBRATION, OSCILLATES, INACCURATE = WORDS[8:]


class Verdict(NamedTuple):
    """One of the :data:`WORDS`, and a sentence with the numbers, what is allowed, and the remedy."""

    verdict: str
    reason: str

    @property
    def in_order(self) -> bool:
        """Whether the run's figures are those of the machine and its law."""
        return self.verdict == IN_ORDER

    def __str__(self) -> str:
        return f"{self.verdict.replace('_', ' ')}: {self.reason}"


def worst(runs: Sequence[tuple[float, Verdict]], kind: str) -> Verdict:
    """The verdict on the run that has the largest error, among those that are not in order if there are any, named
    "``kind`` 2 of 9" if there are several. ``runs``: at least one, error and verdict of each."""
    number = max(range(len(runs)), key=lambda number: (not runs[number][1].in_order, runs[number][0]))
    verdict, reason = runs[number][1]
    return Verdict(verdict, f"{kind} {number + 1} of {len(runs)}: {reason}" if len(runs) > 1 else reason)
