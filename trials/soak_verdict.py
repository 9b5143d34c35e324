"""Result of a soak run: actions by kind, processes that grew, recorded time, bags; and whether the run passed."""

import os
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bench.graph_bench import Usage, growth_mb_per_hour, usage

MEMORY_SPAN_S = 600.0
"""Shortest time over which the slope of a process's memory is meaningful: a logger takes 5 MB in the first four minutes
of its work, and 6 to 8 MB in fifteen."""
MEMORY_LIMIT_MB_PER_HOUR = 60.0
HISTORIES_MB = 60.0
"""What a process may take once: the middleware keeps, for the lease of a killed recorder, the batches that it has not
acknowledged, and does not give their memory back. Driver, feedforward and controller in one process grew by 48 to 51 MB
in the first six kills of the recorder, and by 1 MB in the next eight."""


LONGEST_GAP_S = 0.6
"""Half a stroke: a stalled computer may lose so much of a recording."""


def gaps(stamps: NDArray[np.int64], recorded: Sequence[tuple[int, int]]) -> list[tuple[int, float]]:
    """Begin (ns) and length (s) of each longer time without a sample, while the recording was known to be complete."""
    found, stamps = [], np.unique(stamps)
    for begin, end in recorded:
        times = np.array([begin, *stamps[(stamps > begin) & (stamps < end)], end])
        lengths_s = np.diff(times) * 1e-9
        found += [(int(times[k]), float(lengths_s[k])) for k in np.flatnonzero(lengths_s > LONGEST_GAP_S)]
    return found


_OF_A_THREAD = "/schedstat"
"""A node's file that counts a thread's waits for a CPU: open from the report after the thread's start until the look
after its end, so that there may be one more or less of them than threads for a while."""


class Look(NamedTuple):
    """One process at one time: ns since the epoch, open descriptors without those of :data:`_OF_A_THREAD`, threads,
    resident memory in MB (10⁶ bytes)."""

    time_ns: int
    descriptors: int
    threads: int
    rss_mb: float


def look(process_id: int) -> Look:
    """Look now; OSError if the process has ended."""
    folder, files = f"/proc/{process_id}/fd", []
    for one in os.listdir(folder):
        with suppress(FileNotFoundError):  # closed since
            files.append(os.readlink(f"{folder}/{one}"))
    descriptors = sum(not file.endswith(_OF_A_THREAD) for file in files)
    threads = len(os.listdir(f"/proc/{process_id}/task"))
    return Look(time.time_ns(), descriptors, threads, usage({"": process_id}).rss_mb[""])


@dataclass
class Life:
    """One process, by its node's name, from the end of its warm-up to its end; all looks, oldest first, are taken while
    the whole graph works. The processes that did not survive were killed."""

    name: str
    process_id: int
    looks: list[Look] = field(default_factory=list)
    survived: bool = False

    def to_display(self) -> dict[str, Any]:
        """Values by name, at the first look and the last."""
        first, last = self.looks[0], self.looks[-1]
        seconds = (last.time_ns - first.time_ns) * 1e-9
        slopes = growth_mb_per_hour([Usage(one.time_ns, {}, {"": one.rss_mb}) for one in self.looks])
        return {
            "name": self.name,
            "survived": self.survived,
            "seconds": seconds,
            **{key: [getattr(first, key), getattr(last, key)] for key in ("descriptors", "threads", "rss_mb")},
            "slope_mb_per_hour": slopes[""] if seconds >= MEMORY_SPAN_S else None,
        }

    def failures(self) -> list[str]:
        """Inadmissible growth, in words.

        A look may be taken while a killed peer and its successor are both known: such a peak of descriptors and
        threads is ignored unless it is in the last look.
        """
        shown = self.to_display()
        who = f"{self.name} (process {self.process_id}, {shown['seconds']:.0f} s)"
        counts = {what: shown[what] for what in ("descriptors", "threads")}
        found = [f"{who} has {last} {what} after {first}" for what, (first, last) in counts.items() if last > first]
        slope, (begin, end) = shown["slope_mb_per_hour"], shown["rss_mb"]
        if slope is not None and slope > MEMORY_LIMIT_MB_PER_HOUR and end - begin > HISTORIES_MB:
            found.append(f"the memory of {who} grows by {slope:.0f} MB/h; allowed: {MEMORY_LIMIT_MB_PER_HOUR:g}")
        return found


@dataclass
class Soak:
    """Result of a run.

    Attributes:
        seed, seconds: of the run.
        actions: how often each kind of action was done.
        faults: number of faults latched as required or permitted, by name.
        faults_in_stalls: number of faults that the graph latched by itself while this computer stalled, by name;
            without a stall they are failures.
        answers_lost: service requests that were not answered in time, and were repeated.
        enable_s, back_s: times from a request for the amplifier to 'on', and from an action to normal operation.
        lives: processes.
        recorded_s: time during which the recording was known to be complete.
        bags: numbers ``finished`` and ``recovered``.
        failures: in words, those of an action behind its kind.
    """

    seed: int
    seconds: float = 0.0
    actions: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    faults_in_stalls: Counter[str] = field(default_factory=Counter)
    answers_lost: int = 0
    enable_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    lives: list[Life] = field(default_factory=list)
    recorded_s: float = 0.0
    bags: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def to_display(self) -> dict[str, Any]:
        """Values by name. A run has passed if at least one action was done and nothing failed."""
        failures = self.failures + [words for life in self.lives for words in life.failures()]
        shown = dict(vars(self))
        lives, enable_s, back_s = (shown.pop(name) for name in ("lives", "enable_s", "back_s"))
        return shown | {
            "passed": bool(self.actions) and not failures,
            "longest_enable_s": max(enable_s, default=None),
            "longest_back_to_work_s": max(back_s, default=None),
            "processes": [life.to_display() for life in lives],
            "failures": failures,
        }
