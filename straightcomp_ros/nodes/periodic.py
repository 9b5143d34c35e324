"""A loop at a fixed rate on the process's main thread, with absolute wake-up times."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from collections.abc import Callable
from typing import Protocol

from straightcomp_ros.timing.histogram import Histogram
from straightcomp_ros.timing.report import OVERRUNS, TIMER_ERROR, written

_PR_SET_TIMERSLACK = 29
IDLE_EVERY_NS = 6_000_000
"""Time between two turns of the work that can wait: short turns, that a cycle after them is not late."""


class Loop(Protocol):
    """What runs in the place of an executor."""

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None]) -> None:
        """Loop until ``stopped()``; ``idle`` is called some 150 times a second, for work that can wait."""

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: overruns, and how late the cycles since the last report were."""


class PeriodicLoop:
    """Calls ``cycle`` once in each period. After a stall it goes on with the next period and counts what it
    missed; it never calls twice to catch up.

    A timer of the executor costs a thread and two context switches in each period; here it is one wake-up.

    Args:
        period_ns: length of a period.
        cycle: the work of one period; gets the monotonic time in ns at which the period was to start.
    """

    def __init__(self, period_ns: int, cycle: Callable[[int], object]) -> None:
        self._period_ns = period_ns
        self._cycle = cycle
        self.cycles = 0
        """Periods that were worked."""
        self.overruns = 0
        """Periods that were missed."""
        self._timer_errors = Histogram()

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: overruns, and how late the wake-ups since the last report were."""
        return {OVERRUNS: self.overruns, **written(TIMER_ERROR, self._timer_errors.take())}

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None]) -> None:
        """Loop until ``stopped()``; ``idle`` is called some 150 times a second, for work that can wait."""
        _exact_sleep()
        period_ns, cycle = self._period_ns, self._cycle
        monotonic_ns, sleep, record = time.monotonic_ns, time.sleep, self._timer_errors.record
        give_way = os.sched_yield
        wake_ns = next_idle_ns = monotonic_ns()
        while not stopped():
            wait_ns = wake_ns - monotonic_ns()
            if wait_ns > 0:
                sleep(wait_ns * 1e-9)
            else:
                # At a real-time priority a loop that never sleeps would keep the middleware's threads from running.
                give_way()
            record(monotonic_ns() - wake_ns)
            cycle(wake_ns)
            self.cycles += 1
            if wake_ns >= next_idle_ns:
                idle()
                next_idle_ns = wake_ns + IDLE_EVERY_NS
            wake_ns += period_ns
            behind_ns = monotonic_ns() - wake_ns
            if behind_ns > 0:
                missed = behind_ns // period_ns
                self.overruns += missed
                wake_ns += missed * period_ns


def _exact_sleep() -> None:
    # Linux wakes a normal thread up to 50 µs late on purpose, to save power; a tenth of our period.
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1)
