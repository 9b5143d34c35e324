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


def worst(verdicts: Sequence[Verdict], kind: str) -> Verdict:
    """The first of at least one verdict that is not in order, named "``kind`` 2 of 9" if there are several; the last
    one if all are in order."""
    for number, (verdict, reason) in enumerate(verdicts, 1):
        if verdict != IN_ORDER:
            return Verdict(verdict, f"{kind} {number} of {len(verdicts)}: {reason}" if len(verdicts) > 1 else reason)
    return verdicts[-1]
