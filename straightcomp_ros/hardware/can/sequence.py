"""The number of a frame's sample, from a count that wraps.

A count in the sample's own frame gives the number while by the host's clock fewer samples passed since the last frame
than the count can tell apart. After a longer silence, frames wait for the next frame with the full counter, if the
board has such; otherwise the numbers start anew: they are never guessed. Frames without any count are numbered in
their order; if a row of them comes late by a whole period and more, samples before them were lost.
"""

from collections import deque
from collections.abc import Callable

from straightcomp_ros.hardware.can.frames import Report

_EARLY = 4
"""Samples by which a frame may seem early: late frames may have set the clock."""
_UNSETTLED = 9.0
_KEPT_MISSING = 256
_OLDEST = 1000
_ROW, _LATE = 8, 0.75
"""Frames without count in a row, and the periods by which all are late when samples before them are lost."""
_SILENCE = 10
"""Samples after which the numbers of frames without count start anew."""


class Sequence:
    """Numbers of the samples, and what is missing between them.

    Args:
        elapsed: ``elapsed(index, arrival_ns)`` is the number of samples taken since ``index``, by the clock.
        period_ns: from one sample to the next.
        modulus: of the count in each sample's frame, 0 without one.
        full_modulus: of the full counter in frames of its own, which ``modulus`` divides; 0 without one.
    """

    def __init__(
        self, elapsed: Callable[[int, int], float], period_ns: int, modulus: int, full_modulus: int = 0
    ) -> None:
        self._elapsed, self._period_ns = elapsed, period_ns
        self._modulus, self._full_modulus = modulus, full_modulus
        self._early = min(_EARLY, (modulus - 1) // 3)
        self._ambiguous = modulus - 1 - self._early if modulus else _SILENCE
        self.lost = self.repeated = self.out_of_order = self.unplaced = self.jumps = 0
        self._missing: dict[int, None] = {}
        self.reset()

    @property
    def unsettled(self) -> float:
        """Samples that may have passed while the clock is not settled: no more than the count can tell apart."""
        return min(_UNSETTLED, self._ambiguous - 1.0) if self._modulus else 1.0

    def reset(self) -> None:
        """Start anew: the next frame with a full counter gives the number."""
        self.index: int | None = None
        self._missing.clear()
        self._waiting: list[tuple[Report, int]] = []
        self._lateness: deque[float] = deque(maxlen=_ROW)

    def ahead(self, count: int | None, arrival_ns: int) -> int | None:
        """How many samples a frame is ahead of the newest accepted one, 1 for the next; None if it has to wait.

        With zero or less it carries no new sample, see :meth:`count_old`.
        """
        if self.index is None or self._waiting:
            return None if self._full_modulus else 1
        passed = self._elapsed(self.index, arrival_ns)
        if passed >= self._ambiguous:
            if self._full_modulus:
                return None
            self.jumps += 1
            self.reset()
            return 1
        if count is None:
            return self._in_order(passed)
        ahead = (count - self.index) % self._modulus
        return ahead if ahead <= passed + self._early else ahead - self._modulus

    def _in_order(self, passed: float) -> int:
        self._lateness.append(passed - 1.0)
        late = min(self._lateness)
        if len(self._lateness) < _ROW or late < _LATE:
            return 1
        self._lateness.clear()
        return 1 + round(late)

    def plausible(self, ahead: int, arrival_ns: int) -> bool:
        """Whether a number fits the clock: not in the future, and not more than 1000 samples old."""
        return self.index is None or -_OLDEST < ahead <= self._elapsed(self.index, arrival_ns) + _EARLY

    def accept(self, count: int | None, ahead: int) -> int:
        """Take a frame as the newest sample; return its number, and count those lost before it."""
        if self.index is None:
            self.index = count or 0
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

    def wait(self, report: Report, arrival_ns: int) -> None:
        """Keep a frame until its number is known; the oldest of too many is given up."""
        self._waiting.append((report, arrival_ns))
        if len(self._waiting) > self._modulus - 1:
            del self._waiting[0]
            self.unplaced += 1

    def place(self, counter: int, arrival_ns: int) -> list[tuple[int, tuple[Report, int]]]:
        """Number the waiting frames; returns (number, (report, arrival_ns)) in the order of their arrival.

        ``counter`` came at ``arrival_ns`` in a frame of its own.
        """
        modulus = self._modulus
        ahead = 0 if self.index is None else _signed(counter - self.index, self._full_modulus)
        if not self._waiting:
            if self.index is not None and not -1 <= ahead < modulus - 1:
                self.jumps += 1
                self.reset()
            return []
        number = counter if self.index is None else self.index + ahead
        placed = []
        for waiting in reversed(self._waiting):
            report, waiting_ns = waiting
            number -= self._from_one_to_the_next(number - (report.alive or 0), arrival_ns - waiting_ns)
            arrival_ns = waiting_ns
            placed.append((number, waiting))
        self._waiting = []
        return placed[::-1]

    def _from_one_to_the_next(self, difference: int, passed_ns: int) -> int:
        """Samples between two frames with this difference of their counts; less than zero if they were swapped."""
        lost = difference % self._modulus
        swapped = self._modulus - lost
        # To lose almost as many as the count can tell apart takes as long; swapped frames arrive close together.
        soon = passed_ns / self._period_ns + self._early < lost
        return -swapped if soon and swapped <= self._early else lost


def _signed(difference: int, modulus: int) -> int:
    """The difference of two counters, the shorter way round."""
    return (difference + modulus // 2) % modulus - modulus // 2
