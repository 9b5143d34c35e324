"""A loop at a fixed rate on the process's main thread, with absolute wake-up times."""

import ctypes
import os
import sys
import time
from collections.abc import Callable
from typing import Protocol

from straightcomp_ros.timing.delays import Histogram
from straightcomp_ros.timing.node_timing import TIMER_ERROR, MissedPeriods, written

_PR_SET_TIMERSLACK = 29
IDLE_EVERY_NS = 6_000_000
"""Interval between two turns of idle work, each short so that the next cycle is not late. A turn with less than half a
period left waits for the next period, but at most for one more interval."""
_EARLIER_NS = 50
"""Step by which the loop adapts to the machine's wake-up delay: at 2 kHz it covers 50 µs in half a second."""


class Loop(Protocol):
    """What a node runs instead of an executor."""

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None]) -> None:
        """Loop until ``stopped()``; ``idle`` is called some 150 times a second, for work that can wait."""

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: missed periods, and how late the cycles since the last report were."""


class PeriodicLoop:
    """Calls ``cycle`` once in each period. After a stall it continues with the next period and counts the periods it
    missed; it never calls twice to catch up.

    A timer of the executor costs a thread and two context switches in each period, this loop one wake-up.

    Args:
        period_ns: length of a period.
        cycle: the work of one period; gets the monotonic time in ns at which the period was to start.
        punctual: wake up early by this machine's usual delay and busy-wait for the rest; otherwise every answer would
            be late by a tenth of a period.
    """

    def __init__(self, period_ns: int, cycle: Callable[[int], object], punctual: bool = False) -> None:
        self._period_ns = period_ns
        self._most_early_ns = period_ns // 8 if punctual else 0
        self._early_ns = 0
        self._cycle = cycle
        self.cycles = 0
        """Periods in which ``cycle`` was called."""
        self.missed = MissedPeriods(period_ns)
        """Periods without a call."""
        self._timer_errors = Histogram()

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: missed periods, and how late the wake-ups since the last report were."""
        return {**self.missed.report(), **written(TIMER_ERROR, self._timer_errors.take())}

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None]) -> None:
        """Loop until ``stopped()``; ``idle`` is called some 150 times a second, for work that can wait."""
        _exact_sleep()
        period_ns, cycle, missed = self._period_ns, self._cycle, self.missed
        monotonic_ns, sleep, record = time.monotonic_ns, time.sleep, self._timer_errors.record
        give_way = os.sched_yield
        wake_ns = monotonic_ns()
        idle_turn = IdleWork(idle, wake_ns, period_ns)
        while not stopped():
            wait_ns = wake_ns - self._early_ns - monotonic_ns()
            if wait_ns > 0:
                sleep(wait_ns * 1e-9)
                self._follow(monotonic_ns() - (wake_ns - self._early_ns))
            else:
                # At a real-time priority a loop that never sleeps would keep the middleware's threads from running.
                give_way()
            while monotonic_ns() < wake_ns:
                pass
            record(monotonic_ns() - wake_ns)
            cycle(wake_ns)
            self.cycles += 1
            idle_turn(wake_ns, wake_ns + period_ns - monotonic_ns())
            wake_ns += period_ns
            behind_ns = monotonic_ns() - wake_ns
            if behind_ns > 0:
                periods = behind_ns // period_ns
                missed.count(periods)
                wake_ns += periods * period_ns

    def _follow(self, late_ns: int) -> None:
        """Adapt how early to wake up, so that half of all wake-ups are late."""
        step_ns = _EARLIER_NS if late_ns > self._early_ns else -_EARLIER_NS
        self._early_ns = min(max(0, self._early_ns + step_ns), self._most_early_ns)


class IdleWork:
    """Schedules the turns of idle work; see :data:`IDLE_EVERY_NS`.

    Args:
        idle: does one turn.
        first_ns: time of the first turn, in ns of a monotonic clock.
        period_ns: period of the loop.
    """

    def __init__(self, idle: Callable[[], None], first_ns: int, period_ns: int) -> None:
        self._idle, self._next_ns, self._enough_ns = idle, first_ns, period_ns // 2

    def __call__(self, now_ns: int, left_ns: int) -> None:
        """Do a turn if one is due; call it after a cycle that began at ``now_ns``, ``left_ns`` before the next."""
        late_ns = now_ns - self._next_ns
        if late_ns >= 0 and (left_ns >= self._enough_ns or late_ns >= IDLE_EVERY_NS):
            self._idle()
            self._next_ns = now_ns + IDLE_EVERY_NS


def _exact_sleep() -> None:
    # To save power, Linux wakes a normal thread up to 50 µs late: a tenth of our period.
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1)
