"""From one law to another without a bump in the command.

Both laws answer each sample for a while, and the current goes from the old one's to the new one's by a weight w that
grows by 1/n with each of n samples:

    i = (1 − w) i_old + w i_new

From one sample to the next i changes by no more than

    |Δi| ≤ (1 − w) |Δi_old| + w |Δi_new| + |i_new − i_old| / n

that is, than the laws' own steps and, beyond them, a part of 1/n of their difference, which is at most twice the
current's limit. What the new law does while it finds its own state, with its weight still small, acts by that weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from straightcomp_ros.control.law import Command

FADE_TIME = 0.1
"""s, from the old law to the new one."""


class Stepped(Protocol):
    """A law, or what stands for one."""

    def reset(self, y: float) -> None:
        """As of :class:`~.law.Law`."""

    def step(self, y: float, r: float, r_dot: float, r_ddot: float, current: float = math.nan) -> Command:
        """As of :class:`~.law.Law`."""


class Crossfade:
    """Stands for a law while it is left for another.

    Args:
        old: the law that is left; it may be a crossfade itself.
        new: the law that is to be; it starts at the next sample, at rest.
        samples: over which the weight grows.
        finished: called at the last of them.
    """

    def __init__(self, old: Stepped, new: Stepped, samples: int, finished: Callable[[Crossfade], None]) -> None:
        self._old, self.new, self._samples, self._finished = old, new, samples, finished
        self._done = 0

    def reset(self, y: float) -> None:
        """Start the new law anew; nothing is left to be faded."""
        self.new.reset(y)
        self._finished(self)

    def step(self, y: float, r: float, r_dot: float, r_ddot: float, current: float = math.nan) -> Command:
        """Both laws' answers, the current blended, the rest as the new law has it."""
        if not self._done:
            self.new.reset(y)
        self._done += 1
        weight = self._done / self._samples
        before = self._old.step(y, r, r_dot, r_ddot, current)
        after = self.new.step(y, r, r_dot, r_ddot, current)
        if self._done >= self._samples:
            self._finished(self)
        return after._replace(current=before.current + weight * (after.current - before.current))
