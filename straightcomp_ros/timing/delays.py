"""What a process measures of its own delays: durations of its cycles, samples that did not arrive, waits for a CPU.

Durations are counted in the bins of a floating-point number with four bits of mantissa: 16 for each doubling, so a
percentile is accurate to 6 %, and recording one costs 0.25 µs and no memory. Counts of several histograms can be added,
so the percentiles of a long time follow from the histograms of its seconds; percentiles themselves cannot be added.
"""

from __future__ import annotations

import os
import weakref
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_SUB_BITS = 4
_EXACT = 2 << _SUB_BITS
"""Shorter durations have a bin for each ns."""
_LARGEST_NS = (1 << 40) - 1
"""18 minutes; longer durations count as this one."""
_RESTART_NS = 10_000_000_000
_NEVER_NS = -(2**63)
_BINS = ((40 - _SUB_BITS - 1) << _SUB_BITS) + _EXACT


@dataclass(frozen=True)
class Distribution:
    """Recorded durations: the count of each bin that is not empty, bins ascending, and the longest duration in ns."""

    counts: Mapping[int, int]
    largest_ns: int

    def percentiles_us(self, percents: Sequence[float]) -> list[float]:
        """For each of ``percents``, ascending: the percentile of the durations in µs; NaN without any."""
        total = sum(self.counts.values())
        found: list[float] = []
        below = 0
        for place, count in self.counts.items():
            while len(found) < len(percents) and percents[len(found)] / 100.0 * total <= below + count:
                inside = (percents[len(found)] / 100.0 * total - below) / count
                low = _edge(place)
                found.append(min(low + inside * (_edge(place + 1) - low), self.largest_ns) * 1e-3)
            below += count
        return found + [float("nan")] * (len(percents) - len(found))

    @property
    def largest_us(self) -> float:
        """The longest duration in µs; NaN without any."""
        return self.largest_ns * 1e-3 if self.counts else float("nan")

    def __add__(self, other: Distribution) -> Distribution:
        counts = Counter(self.counts) + Counter(other.counts)
        return Distribution(dict(sorted(counts.items())), max(self.largest_ns, other.largest_ns))

    def to_text(self) -> str:
        """One line: the longest duration in ns, then ``bin:count`` for the bins that are not empty."""
        return " ".join([str(self.largest_ns), *(f"{place}:{count}" for place, count in self.counts.items())])

    @staticmethod
    def from_text(text: str) -> Distribution:
        """The inverse of :meth:`to_text`; ValueError for any other text."""
        largest, *pairs = text.split()
        counts = {int(place): int(count) for place, count in (pair.split(":") for pair in pairs)}
        if any(not 0 <= place < _BINS or count < 1 for place, count in counts.items()):
            raise ValueError(f"histogram '{text}': allowed: bins 0 to {_BINS - 1}, counts above 0")
        return Distribution(counts, int(largest))


def _edge(place: int) -> int:
    """The shortest duration in a bin, ns."""
    exponent = max((place >> _SUB_BITS) - 1, 0)
    return (place - (exponent << _SUB_BITS)) << exponent


NOTHING = Distribution({}, 0)
"""No durations: the start value of sums."""


class Histogram:
    """Counts durations until :meth:`take` is called."""

    def __init__(self) -> None:
        self._counts = [0] * _BINS
        self._largest_ns = 0

    def record(self, duration_ns: int) -> None:
        """Count one duration in ns; a negative one counts as zero."""
        if duration_ns > self._largest_ns:
            duration_ns = min(duration_ns, _LARGEST_NS)
            self._largest_ns = duration_ns
        exponent = duration_ns.bit_length() - _SUB_BITS - 1
        if exponent > 0:
            self._counts[(exponent << _SUB_BITS) + (duration_ns >> exponent)] += 1
        else:
            self._counts[duration_ns if duration_ns > 0 else 0] += 1

    def take(self) -> Distribution:
        """The durations since the last call."""
        taken = Distribution({place: count for place, count in enumerate(self._counts) if count}, self._largest_ns)
        self._counts[:], self._largest_ns = [0] * _BINS, 0
        return taken


class StampGaps:
    """Watches the stamps of a stream whose samples lie on a grid; the grid's period is the smallest step seen so far.

    A step backwards, or one longer than ten seconds, is a restart of the source and no loss.

    Attributes:
        lost: samples of the grid between two stamps seen that did not arrive.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last_ns = _NEVER_NS
        self._period_ns = _RESTART_NS

    def see(self, stamp_ns: int) -> None:
        """Take the stamp of the next sample; a repeated sample changes nothing."""
        step, self._last_ns = stamp_ns - self._last_ns, stamp_ns
        if 0 < step < self._period_ns:
            self._period_ns = step
        elif self._period_ns < step < _RESTART_NS:
            self.lost += round(step / self._period_ns) - 1

    def interrupt(self) -> None:
        """Do not count the gap before the next sample: those in it were left out on purpose."""
        self._last_ns = _NEVER_NS


class ThreadWaits:
    """How long the threads of this process wait for a CPU; several :class:`CpuWait` share its looks.

    Linux's scheduler counts it for each thread (the second number in ``/proc/PID/task/TID/schedstat``), without the
    time that a hypervisor takes from the whole machine. A system without these counts reports no wait.
    """

    def __init__(self, threads: Path = Path("/proc/self/task")) -> None:
        self._threads = threads
        self._files: dict[str, BinaryIO] = {}
        self._waited_ns: dict[str, int] = {}
        self._turn = 0
        self.readers: weakref.WeakSet[CpuWait] = weakref.WeakSet()

    def look(self) -> None:
        """Read how long the threads have waited since the last look at them: each reader's look is at its share."""
        longest_ns, self._turn = 0, self._turn + 1
        for thread, file in list(self._files.items())[self._turn % len(self.readers) :: len(self.readers)]:
            try:
                waited_ns = int(os.pread(file.fileno(), 100, 0).split()[1])
            except (OSError, IndexError, ValueError):
                # The thread has ended.
                self._files.pop(thread).close()
                self._waited_ns.pop(thread, None)
                continue
            longest_ns = max(longest_ns, waited_ns - self._waited_ns.get(thread, waited_ns))
            self._waited_ns[thread] = waited_ns
        for reader in self.readers:
            reader.longest_ns = max(reader.longest_ns, longest_ns)

    def find(self) -> None:
        """Include the threads that have started since the last call."""
        with suppress(OSError):
            for thread in set(os.listdir(self._threads)) - set(self._files):
                with suppress(OSError):
                    self._files[thread] = (self._threads / thread / "schedstat").open("rb")


_OWN = ThreadWaits()


class CpuWait:
    """The longest time for which a thread of this process was ready to run but got no CPU, between two looks.

    Short waits between two looks add up: look often to distinguish one long wait from many short ones.
    """

    def __init__(self, waits: ThreadWaits = _OWN) -> None:
        self._waits = waits
        self.longest_ns = 0
        waits.readers.add(self)

    def look(self) -> None:
        """Look at this node's share of the threads."""
        self._waits.look()

    def take_us(self) -> float:
        """The longest wait since the last call, in µs; threads started since then are included from now on."""
        self._waits.find()
        self._waits.look()
        longest_ns, self.longest_ns = self.longest_ns, 0
        return longest_ns * 1e-3
