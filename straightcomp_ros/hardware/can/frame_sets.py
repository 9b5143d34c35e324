"""Frames of several messages that belong together: those of one sample, or those of one command.

They belong together if they have the same count, and if not half as many periods lie between them as the count can tell
apart: then it has begun again. Where a message has none, they do if they arrive within half a period
of the first; two samples then differ by more, unless the bus or the host is late by that much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from straightcomp_ros.hardware.can.frames import Command, Report

Frame = TypeVar("Frame", Report, Command)
OPEN = 3
"""Sets that may wait for frames: on a bus, frames of two samples are swapped, never those of many."""


@dataclass
class _Set(Generic[Frame]):
    count: int
    begin_ns: int
    frames: list[Frame | None]
    missing: int
    closed: bool = False


class FrameSets(Generic[Frame]):
    """Collects frames; a set that is not complete when a later one is, or when too many wait, is given up.

    Args:
        messages: number of messages in a set.
        modulus: of the count by which frames belong together; 0: by their time.
        period_ns: from one set to the next.

    Attributes:
        incomplete: sets that were given up.
        repeated: frames that came twice.
        out_of_order: frames that came after one of a later set.
    """

    def __init__(self, messages: int, modulus: int, period_ns: int) -> None:
        self._messages, self._modulus = messages, modulus
        self._longest_ns = period_ns * (modulus or 1) // 2
        self._sets: list[_Set[Frame]] = []
        """Oldest first."""
        self.incomplete = self.repeated = self.out_of_order = 0

    def reset(self) -> None:
        """Forget all frames."""
        self._sets.clear()

    def add(self, message: int, frame: Frame, count: int, at_ns: int) -> tuple[Frame, int] | None:
        """Take a frame of the ``message``-th message; return the whole set if it is now complete.

        ``at_ns`` is the time of arrival. The result has each field from the first message that has it, and the time of
        arrival of the set's first frame.
        """
        sets = self._sets
        own = self._counted(count % self._modulus, at_ns) if self._modulus else self._recent(message, at_ns)
        if own is None:
            own = _Set(count % self._modulus if self._modulus else 0, at_ns, [None] * self._messages, self._messages)
            sets.append(own)
            if len(sets) > OPEN:
                self._close(sets.pop(0))
        elif own.frames[message] is not None:
            self.repeated += 1
            return None
        elif own is not sets[-1]:
            self.out_of_order += 1
        own.frames[message] = frame
        own.missing -= 1
        if own.missing or own.closed:
            return None
        own.closed = True
        for earlier in sets:
            if earlier is own:
                break
            self._close(earlier)
        return together([part for part in own.frames if part is not None]), own.begin_ns

    def _counted(self, count: int, at_ns: int) -> _Set[Frame] | None:
        for known in reversed(self._sets):
            if known.count == count and at_ns - known.begin_ns <= self._longest_ns:
                return known
        return None

    def _recent(self, message: int, at_ns: int) -> _Set[Frame] | None:
        newest = self._sets[-1] if self._sets else None
        if newest is None or newest.closed or newest.frames[message] is not None:
            return None
        return newest if at_ns - newest.begin_ns < self._longest_ns else None

    def _close(self, given_up: _Set[Frame]) -> None:
        self.incomplete += not given_up.closed
        given_up.closed = True


def together(frames: Sequence[Frame]) -> Frame:
    """One frame with each field of the first of ``frames`` that has it; readings are good if all say so."""
    whole = frames[0]
    for other in frames[1:]:
        fields = [one if one is not None else its for one, its in zip(whole, other, strict=True)]
        whole = type(whole)._make(fields)
    if isinstance(whole, Report) and not all(frame.good for frame in frames if isinstance(frame, Report)):
        return whole._replace(good=False)
    return whole
