"""The number of a frame's sample, from a counter that wraps.

A frame for CAN FD has the sample counter itself. A classic one has only its remainder by 15, which gives the number
while by the host's clock fewer than ten samples passed since the last frame. After a longer silence, frames wait for
the next frame with the full counter, at most ten samples later: numbers are never guessed.
"""

from collections.abc import Callable

from straightcomp_ros.hardware.can.frames import ALIVE_MODULUS, COUNTER_MODULUS, Encoder

_AMBIGUOUS = 10
_EARLY = ALIVE_MODULUS - 1 - _AMBIGUOUS
"""Samples by which a frame may seem early: late frames may have set the clock."""
_MOST_WAITING = ALIVE_MODULUS - 1
_KEPT_MISSING = 256


class Sequence:
    """Numbers of the samples, and what is missing between them.

    ``elapsed(index, arrival_ns)`` is the number of samples taken since ``index``, by the clock.
    """

    def __init__(self, elapsed: Callable[[int, int], float]) -> None:
        self._elapsed = elapsed
        self.lost = self.repeated = self.out_of_order = self.unplaced = self.jumps = 0
        self._missing: dict[int, None] = {}
        self.reset()

    def reset(self) -> None:
        """Start anew: the next frame with a full counter gives the number."""
        self.index: int | None = None
        self._missing.clear()
        self._waiting: list[tuple[Encoder, int]] = []

    def ahead(self, frame: Encoder, arrival_ns: int) -> int | None:
        """How many samples a frame is ahead of the newest accepted one, 1 for the next; None if it has to wait.

        With zero or less it carries no new sample, see :meth:`count_old`.
        """
        if frame.counter is not None:
            return 1 if self.index is None else _signed(frame.counter - self.index, COUNTER_MODULUS)
        if self.index is None or self._waiting:
            return None
        passed = self._elapsed(self.index, arrival_ns)
        if passed >= _AMBIGUOUS:
            return None
        ahead = (frame.alive - self.index) % ALIVE_MODULUS
        return ahead if ahead <= passed + _EARLY else ahead - ALIVE_MODULUS

    def plausible(self, ahead: int, arrival_ns: int) -> bool:
        """Whether a full counter fits the clock: not in the future, and not more than 1000 samples old."""
        return self.index is None or -1000 < ahead <= self._elapsed(self.index, arrival_ns) + _EARLY

    def accept(self, frame: Encoder, ahead: int) -> int:
        """Take the frame as the newest sample; return its number, and count those lost before it."""
        if self.index is None:
            self.index = frame.counter or 0
            return self.index
        self._missing |= dict.fromkeys(range(self.index + 1, self.index + min(ahead, _KEPT_MISSING)))
        while len(self._missing) > _KEPT_MISSING:
            del self._missing[next(iter(self._missing))]
        self.lost += ahead - 1
        self.index += ahead
        return self.index

    def count_old(self, ahead: int) -> None:
        """Count a frame without a new sample: one that was missing, or one that is repeated."""
        number = (self.index or 0) + ahead
        if number in self._missing:
            del self._missing[number]
            self.lost -= 1
            self.out_of_order += 1
        else:
            self.repeated += 1

    def wait(self, frame: Encoder, arrival_ns: int) -> None:
        """Keep a frame until its number is known; the oldest of too many is given up."""
        self._waiting.append((frame, arrival_ns))
        if len(self._waiting) > _MOST_WAITING:
            del self._waiting[0]
            self.unplaced += 1

    def place(self, counter: int, alive: int) -> list[tuple[int, tuple[Encoder, int]]]:
        """Number the waiting frames; returns (number, (frame, arrival_ns)), oldest first.

        ``counter`` is the number of the newest encoder frame's sample or of one before it, ``alive`` that frame's own.
        """
        ahead = 0 if self.index is None else _signed(counter - self.index, COUNTER_MODULUS)
        if not self._waiting:
            if self.index is not None and not -1 <= ahead < ALIVE_MODULUS - 1:
                self.jumps += 1
                self.reset()
            return []
        full = counter if self.index is None else self.index + ahead
        number = full - (full - alive) % ALIVE_MODULUS
        placed = []
        later = alive
        for waiting in reversed(self._waiting):
            number -= (later - waiting[0].alive) % ALIVE_MODULUS
            later = waiting[0].alive
            placed.append((number, waiting))
        self._waiting = []
        return placed[::-1]


def _signed(difference: int, modulus: int) -> int:
    """The difference of two counters, the shorter way round."""
    return (difference + modulus // 2) % modulus - modulus // 2
