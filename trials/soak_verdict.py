"""Result of a soak run: actions by kind, processes that grew, strokes, bags; and whether the run passed."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from straightcomp_ros.bench.processes import Usage, descriptors, threads, usage
from straightcomp_ros.bench.window import growth_mb_per_hour

MEMORY_SPAN_S = 600.0
"""Shortest time over which the slope of a process's memory is meaningful: a logger takes 5 MB in the first four minutes
of its work, and 6 to 8 MB in fifteen."""
MEMORY_LIMIT_MB_PER_HOUR = 60.0


class Look(NamedTuple):
    """One process at one time: ns since the epoch, open descriptors, threads, resident memory in MB (10⁶ bytes)."""

    time_ns: int
    descriptors: int
    threads: int
    rss_mb: float


def look(process_id: int) -> Look:
    """Look now.

    Raises:
        OSError: the process has ended.
    """
    memory = usage({"": process_id}).rss_mb[""]
    return Look(time.time_ns(), descriptors(process_id), threads(process_id), memory)


@dataclass
class Life:
    """One process from the end of its warm-up to its end; all looks are taken while the whole graph works.

    Attributes:
        name: of the node.
        process_id: of the process.
        looks: oldest first.
        survived: it was running at the run's end; the others were killed.
    """

    name: str
    process_id: int
    looks: list[Look] = field(default_factory=list)
    survived: bool = False

    @property
    def seconds(self) -> float:
        """From the first look to the last."""
        return (self.looks[-1].time_ns - self.looks[0].time_ns) * 1e-9

    @property
    def slope_mb_per_hour(self) -> float:
        """Slope of its memory, least squares over all looks; NaN with fewer than two."""
        of_all = [Usage(look.time_ns, {}, {self.name: look.rss_mb}) for look in self.looks]
        return growth_mb_per_hour(of_all)[self.name]

    def failures(self) -> list[str]:
        """Inadmissible growth, in words.

        Descriptors and threads: the last look has more than the first. A look may be taken while a killed peer is still
        known beside its successor; such a peak is ignored unless it is in the last look.
        """
        first, last = self.looks[0], self.looks[-1]
        who = f"{self.name} (process {self.process_id}, {self.seconds:.0f} s)"
        found = [
            f"{who} has {getattr(last, what)} {words} after {getattr(first, what)}"
            for what, words in (("descriptors", "open descriptors"), ("threads", "threads"))
            if getattr(last, what) > getattr(first, what)
        ]
        if self.seconds >= MEMORY_SPAN_S and self.slope_mb_per_hour > MEMORY_LIMIT_MB_PER_HOUR:
            slope, limit = self.slope_mb_per_hour, MEMORY_LIMIT_MB_PER_HOUR
            found.append(f"the memory of {who} grows by {slope:.0f} MB/h; allowed: {limit:g}")
        return found

    def to_display(self) -> dict[str, Any]:
        """Values by name, as `straightcomp soak --json` prints them."""
        first, last = self.looks[0], self.looks[-1]
        return {
            "name": self.name,
            "survived": self.survived,
            "seconds": self.seconds,
            "descriptors": [first.descriptors, last.descriptors],
            "threads": [first.threads, last.threads],
            "rss_mb": [first.rss_mb, last.rss_mb],
            "slope_mb_per_hour": self.slope_mb_per_hour if self.seconds >= MEMORY_SPAN_S else None,
        }


class Lives:
    """All processes of a run."""

    def __init__(self) -> None:
        self._all: dict[int, Life] = {}

    def see(self, process_ids: Mapping[str, int]) -> None:
        """Take a look at each process; a new process is added with this look.

        Raises:
            OSError: one has ended.
        """
        for name, process_id in process_ids.items():
            self._all.setdefault(process_id, Life(name, process_id)).looks.append(look(process_id))

    def __contains__(self, process_id: int) -> bool:
        return process_id in self._all

    def finished(self, survivors: Sequence[int]) -> list[Life]:
        """Processes with more than one look, marked if they survived."""
        for process_id, life in self._all.items():
            life.survived = process_id in survivors
        return [life for life in self._all.values() if len(life.looks) > 1]


@dataclass
class Actions:
    """One kind of action: the number of runs, the number of runs with failures, and the failures in words."""

    done: int = 0
    failed: int = 0
    failures: list[str] = field(default_factory=list)

    def add(self, failures: Sequence[str]) -> None:
        """Count one action."""
        self.done += 1
        self.failed += bool(failures)
        self.failures += failures


@dataclass
class Soak:
    """Result of a run.

    Attributes:
        seed, seconds: of the run.
        actions: by kind.
        faults: number of faults latched as required or permitted, by name.
        stalls: number of faults that the graph latched by itself while this computer stalled
            (:mod:`trials.stalls`), by name; without a stall they are failures.
        answers_lost: service requests that were not answered in time, and were repeated.
        enable_s, back_s: times from a request for the amplifier to 'on', and from an action to normal operation.
        lives: processes.
        strokes: numbers ``commanded`` and ``found``, as :mod:`trials.soak_strokes` defines.
        bags: numbers ``finished`` and ``recovered``.
        failures: those that belong to no action.
    """

    seed: int
    seconds: float = 0.0
    actions: dict[str, Actions] = field(default_factory=dict)
    faults: Counter[str] = field(default_factory=Counter)
    stalls: Counter[str] = field(default_factory=Counter)
    answers_lost: int = 0
    enable_s: list[float] = field(default_factory=list)
    back_s: list[float] = field(default_factory=list)
    lives: list[Life] = field(default_factory=list)
    strokes: dict[str, int] = field(default_factory=dict)
    bags: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def all_failures(self) -> list[str]:
        """Every failure in words."""
        of_actions = [f"{kind}: {words}" for kind, actions in self.actions.items() for words in actions.failures]
        return of_actions + [words for life in self.lives for words in life.failures()] + self.failures

    @property
    def passed(self) -> bool:
        """Whether at least one action was done and nothing failed."""
        return any(actions.done for actions in self.actions.values()) and not self.all_failures()

    def to_display(self) -> dict[str, Any]:
        """Values by name, as `straightcomp soak --json` prints them."""
        return {
            "seed": self.seed,
            "seconds": self.seconds,
            "passed": self.passed,
            "actions": {
                kind: {"done": actions.done, "failed": actions.failed} for kind, actions in self.actions.items()
            },
            "faults": dict(self.faults),
            "faults_in_stalls": dict(self.stalls),
            "answers_lost": self.answers_lost,
            "longest_enable_s": max(self.enable_s, default=None),
            "longest_back_to_work_s": max(self.back_s, default=None),
            "processes": [life.to_display() for life in self.lives],
            "strokes": self.strokes,
            "bags": dict(self.bags),
            "failures": self.all_failures(),
        }


def exits(codes: Mapping[str, int | None]) -> list[str]:
    """Which nodes did not end with exit code 0 after an interrupt, in words."""
    return [
        f"{name} did not stop" if code is None else f"{name} stopped with exit code {code}"
        for name, code in codes.items()
        if code != 0
    ]
