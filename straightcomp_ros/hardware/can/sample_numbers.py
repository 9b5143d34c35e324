"""Number and time of each sample: which frames belong to it, which number it has, and when the board took it.

Frames of several messages belong together, to one sample or to one command, if they have the same count, and if not
half as many periods lie between them as the count distinguishes: then it has begun again. Where a message has none,
they do if they arrive within half a period of the first; two samples then differ by more, unless the bus or the host is
late by that much.

A count in the sample's own frame gives the number while by the host's clock fewer samples passed since the last frame
than the count distinguishes. After a longer silence, the next frame with the full counter gives the number of the
sample right before it, if the board has such; otherwise the numbers start anew: they are never guessed. Frames without
any count are numbered in their order; if a row of them comes late by a whole period and more, samples before them were
lost.

Frames are late by a varying amount, but never early. The stamps therefore follow a line through the promptest frame of
each block. A first-order correction of its offset and an integral correction of its rate make it follow a quartz that
is off by 100 ppm and more. The line bends but never jumps: stamps rise by about a period each. A board at another rate
shows in the first block, by the promptest frames of its halves; the line then begins anew with the next one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from straightcomp_ros.hardware.can.frames import Command, Report

Frame = TypeVar("Frame", Report, Command)
OPEN = 3
"""Sets that may wait for frames: on a bus, frames of two samples are swapped, never those of many."""

BLOCK = 128
"""Samples of a block: 64 ms at 2 kHz."""
_PLACE_GAIN, _RATE_GAIN = 0.5, 0.1
_MOST_CORRECTION = 0.1
"""Of the offset, in periods per block: a stalled host must not drag the clock along."""
_MOST_EARLY = 16.0
"""Periods: an eighth of a block, so that stamps still rise while the line is corrected."""
_MOST_RATE = 1e-3
_LOST_PERIODS, _LOST_BLOCKS = 4.0, 4
_EARLY = 4
"""Samples by which a frame may seem early: late frames may have set the clock."""
_UNSETTLED = 9.0
_KEPT_MISSING = 256
_OLDEST = 1000
_ROW, _LATE = 8, 0.75
"""Frames without count in a row, and the periods by which all are late when samples before them are lost."""
_SILENCE = 10
"""Samples after which the numbers of frames without count start anew."""


@dataclass(eq=False)
class _Set(Generic[Frame]):
    count: int
    begin_ns: int
    frames: dict[int, Frame]
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
        sets, count = self._sets, count % self._modulus if self._modulus else 0
        own = next((known for known in reversed(sets) if self._belongs(known, message, count, at_ns)), None)
        if own is None:
            own = _Set(count, at_ns, {})
            sets.append(own)
        elif message in own.frames:
            self.repeated += 1
            return None
        elif own is not sets[-1]:
            self.out_of_order += 1
        own.frames[message] = frame
        whole = len(own.frames) == self._messages and not own.closed
        # Those before a whole one are given up, and so is the oldest of too many.
        for given_up in sets[: sets.index(own)] if whole else sets[:-OPEN]:
            self.incomplete += not given_up.closed
            given_up.closed = True
        del sets[:-OPEN]
        if not whole:
            return None
        own.closed = True
        return together([frame for _, frame in sorted(own.frames.items())]), own.begin_ns

    def _belongs(self, known: _Set[Frame], message: int, count: int, at_ns: int) -> bool:
        passed_ns = at_ns - known.begin_ns
        if self._modulus:
            return known.count == count and passed_ns <= self._longest_ns
        waits = known is self._sets[-1] and not known.closed and message not in known.frames
        return waits and passed_ns < self._longest_ns


def together(frames: Sequence[Frame]) -> Frame:
    """One frame with each field of the first of ``frames`` that has it; readings are good if all say so."""
    whole = frames[0]
    for other in frames[1:]:
        fields = [one if one is not None else its for one, its in zip(whole, other, strict=True)]
        whole = type(whole)._make(fields)
    if isinstance(whole, Report) and not all(frame.good for frame in frames if isinstance(frame, Report)):
        return whole._replace(good=False)
    return whole


class SampleClock:
    """Line ``stamp(index)`` in ns through the times of arrival; :attr:`settled` after the first block.

    A stamp is late by the shortest time from sampling to arrival. ``period_ns`` is the nominal sampling period.

    Attributes:
        other_rate: Hz, at which the board seems to sample if that is not the nominal rate, which keeps the line from
            settling; else 0.
    """

    def __init__(self, period_ns: int) -> None:
        self._nominal = float(period_ns)
        self.reset()

    def reset(self) -> None:
        self.settled, self.other_rate = False, 0.0
        self._origin_index = self._origin_ns = self._lost_blocks = 0
        self._place = self._rate = self._bend = 0.0
        self._slope = self._nominal
        self._least = [float("inf")] * 2
        """Lateness of the promptest frame in each half of the block, ns."""

    def stamp(self, index: int) -> int:
        """Time of the sample ``index`` in ns."""
        return self._origin_ns + round(self._place + (index - self._origin_index) * self._slope)

    def elapsed(self, index: int, arrival_ns: int) -> float:
        """Samples that the board has taken since ``index`` by the time ``arrival_ns``."""
        return (arrival_ns - self.stamp(index)) / self._slope

    def observe(self, index: int, arrival_ns: int) -> None:
        """Take the time of arrival of a sample; samples come in order, some may be missing."""
        if not self.settled and self._least[0] == float("inf"):
            self._origin_index, self._origin_ns = index, arrival_ns
        step = index - self._origin_index
        late = arrival_ns - self._origin_ns - self._place - step * self._slope
        # As seen from the end of the block, when the line has been bent.
        late -= (BLOCK - step) * self._bend
        half = step >= BLOCK // 2
        if late < self._least[half]:
            self._least[half] = late
        if step >= BLOCK - 1:
            self._end_block(index)

    def _end_block(self, index: int) -> None:
        (first, second), self._least = self._least, [float("inf")] * 2
        late = min(first, second)
        if not self.settled:
            if abs(second - first) > _LOST_PERIODS * self._nominal:
                # 6 %, or the host stood still throughout one half: the next block shows which.
                self.reset()
                period_ns = self._nominal + (second - first) / (BLOCK // 2)
                # None passes between frames that are read at once.
                self.other_rate = 1e9 / period_ns if period_ns > 0.0 else 0.0
                return
            self._place += late
            self.settled, self.other_rate = True, 0.0
            return
        # An error of whole periods in block after block is no jitter: the board's clock was interrupted.
        self._lost_blocks = self._lost_blocks + 1 if abs(late) > _LOST_PERIODS * self._nominal else 0
        if self._lost_blocks >= _LOST_BLOCKS:
            self.reset()
            return
        # Late frames prove little, but an early one proves that the line is too late.
        late = min(max(late, -_MOST_EARLY * self._nominal), _MOST_CORRECTION * self._nominal)
        usual = max(late, -_MOST_CORRECTION * self._nominal)
        self._rate = min(max(self._rate + _RATE_GAIN * usual / BLOCK / self._nominal, -_MOST_RATE), _MOST_RATE)
        here = self._place + (index - self._origin_index) * self._slope
        whole = round(here)
        self._origin_index, self._origin_ns, self._place = index, self._origin_ns + whole, here - whole
        self._bend = _PLACE_GAIN * late / BLOCK
        self._slope = self._nominal * (1.0 + self._rate) + self._bend


class SampleNumbers:
    """Numbers of the samples, and what is missing between them.

    Args:
        clock: follows the samples, and says how many have been taken; it starts anew with the numbers.
        period_ns: from one sample to the next.
        modulus: of the count in each sample's frame, 0 without one.
        full_modulus: of the full counter in frames of its own, which ``modulus`` divides; 0 without one.

    Attributes:
        index: number of the newest accepted sample; None before the first.
        jumps: how often the numbers started anew by themselves.
    """

    def __init__(self, clock: SampleClock, period_ns: int, modulus: int, full_modulus: int = 0) -> None:
        self._clock, self._period_ns = clock, period_ns
        self._modulus, self._full_modulus = modulus, full_modulus
        self._early = min(_EARLY, (modulus - 1) // 3)
        self._ambiguous = modulus - 1 - self._early if modulus else _SILENCE
        self.lost = self.repeated = self.out_of_order = self.jumps = 0
        self._missing: deque[int] = deque(maxlen=_KEPT_MISSING)
        self._newest_ns = 0
        self.reset()

    def reset(self) -> None:
        """Start anew: the next frame with a full counter gives the number."""
        self.index: int | None = None
        self._missing.clear()
        self._waiting: tuple[Report, int] | None = None
        self._lateness: deque[float] = deque(maxlen=_ROW)
        self._clock.reset()

    def _jump(self) -> None:
        self.jumps += 1
        self.reset()

    def _passed(self, index: int, arrival_ns: int) -> float:
        """Samples that the board has taken since ``index``."""
        if self._clock.settled:
            return self._clock.elapsed(index, arrival_ns)
        # The first frames may all be late, so the time between two of them is not yet meaningful. No more samples may
        # have passed than the count distinguishes.
        unsettled = min(_UNSETTLED, self._ambiguous - 1.0) if self._modulus else 1.0
        return max((arrival_ns - self._newest_ns) / self._period_ns, unsettled)

    def ahead(self, count: int | None, arrival_ns: int) -> int | None:
        """How many samples a frame is ahead of the newest accepted one, 1 for the next; None while that is not known.

        With zero or less it carries no new sample, see :meth:`count_old`.
        """
        if self.index is None:
            return None if self._full_modulus else 1
        passed = self._passed(self.index, arrival_ns)
        if passed >= self._ambiguous:
            if self._full_modulus:
                return None
            self._jump()
            return 1
        if count is not None:
            ahead = (count - self.index) % self._modulus
            return ahead if ahead <= passed + self._early else ahead - self._modulus
        # In their order, unless a row of them is late.
        self._lateness.append(passed - 1.0)
        late = min(self._lateness)
        if len(self._lateness) < _ROW or late < _LATE:
            return 1
        self._lateness.clear()
        return 1 + round(late)

    def plausible(self, ahead: int, arrival_ns: int) -> bool:
        """Whether a number fits the clock: not in the future, and not more than 1000 samples old."""
        return self.index is None or -_OLDEST < ahead <= self._passed(self.index, arrival_ns) + _EARLY

    def accept(self, count: int | None, ahead: int, arrival_ns: int) -> int:
        """Take a frame as the newest sample; return its number, and count those lost before it."""
        if self.index is None:
            self.index = count or 0
        else:
            self._missing.extend(range(self.index + 1, self.index + min(ahead, _KEPT_MISSING)))
            self.lost += ahead - 1
            self.index += ahead
        self._newest_ns = arrival_ns
        self._clock.observe(self.index, arrival_ns)
        return self.index

    def count_old(self, ahead: int) -> None:
        """Count a frame without a new sample: one that was missing, or one that is repeated."""
        number = (self.index or 0) + ahead
        if number in self._missing:
            self._missing.remove(number)
            self.lost -= 1
            self.out_of_order += 1
        else:
            self.repeated += 1

    def wait(self, report: Report, arrival_ns: int) -> None:
        """Keep a frame whose number is not known, in place of the one before it: the full counter may come next."""
        self._waiting = report, arrival_ns

    def place(self, counter: int, arrival_ns: int) -> tuple[Report, int, int] | None:
        """The waiting frame if a full counter is that of its sample: report, how many samples it is ahead, arrival."""
        half = self._full_modulus // 2
        ahead = 1 if self.index is None else (counter - self.index + half) % self._full_modulus - half
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            if self.index is not None and not -1 <= ahead < self._modulus - 1:
                self._jump()
            return None
        report, waiting_ns = waiting
        # Another sample with the same count is older.
        matches = (counter - (report.alive or 0)) % self._modulus == 0
        soon = arrival_ns - waiting_ns < self._modulus * self._period_ns
        return (report._replace(counter=counter), ahead, waiting_ns) if matches and soon else None
