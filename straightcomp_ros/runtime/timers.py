"""All timers of a node, served by a single timer of the executor.

When a timer is added to an EventsExecutor (rclpy 7.1) or reset, or when the ROS clock steps, the executor queues every
timer again that is due at that moment. Such timers fire several times at once, and then stay silent until their
schedule catches up: for seconds, after a slow start. A single timer on the steady clock is never queued twice.
"""

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from straightcomp_ros.runtime.guarded_node import GuardedNode

TICK_S = 0.02
"""Resolution of the timers."""
_TICK_NS = round(TICK_S * 1e9)


class SteadyTimer:
    """Calls ``callback`` every ``period_ns`` until cancelled; after a stall once, not once for each missed period."""

    def __init__(self, period_ns: int, callback: Callable[[], object], first_ns: int) -> None:
        self._period_ns, self._callback = period_ns, callback
        self.due_ns: float = first_ns

    def cancel(self) -> None:
        """Never call again."""
        self.due_ns = float("inf")

    def call(self, now_ns: int) -> None:
        """Call now; the next call is due one period after this one was due."""
        self.due_ns += self._period_ns
        if self.due_ns <= now_ns:
            self.due_ns = now_ns + self._period_ns
        self._callback()


class SteadyTimers:
    """Timers that are called in the order in which they are due.

    Args:
        monotonic_ns: the clock.
    """

    def __init__(self, monotonic_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._monotonic_ns = monotonic_ns
        self._begin_ns = monotonic_ns()
        self._timers: list[SteadyTimer] = []

    def add(self, period_s: float, callback: Callable[[], object]) -> SteadyTimer:
        """A new timer; its first call is due after ``period_s``, at a tick."""
        period_ns = round(period_s * 1e9)
        # A timer that is due between two ticks would be called at one or the other, depending on their jitter.
        ticks = -((self._begin_ns - self._monotonic_ns()) // _TICK_NS)
        timer = SteadyTimer(period_ns, callback, self._begin_ns + ticks * _TICK_NS + period_ns)
        self._timers.append(timer)
        return timer

    def mark(self) -> int:
        """The number of timers so far, for :meth:`cancel_after`."""
        return len(self._timers)

    def cancel_after(self, mark: int) -> None:
        """Cancel the timers that were added after :meth:`mark`."""
        for timer in self._timers[mark:]:
            timer.cancel()
        del self._timers[mark:]

    def call_one(self) -> bool:
        """Call the timer that has been due longest; returns whether one was due."""
        now_ns = self._monotonic_ns()
        timer = min(self._timers, key=lambda timer: timer.due_ns, default=None)
        if timer is None or timer.due_ns > now_ns:
            return False
        timer.call(now_ns)
        return True

    def call_all(self) -> None:
        """Call each timer that is due, once."""
        for _ in range(len(self._timers)):
            if not self.call_one():
                return


class WithSteadyTimers(GuardedNode):
    """A node whose timers keep their periods under an EventsExecutor too.

    A loop that spins the executor one event at a time calls :meth:`SteadyTimers.call_one` between its cycles.
    """

    _steady_timers: SteadyTimers | None = None

    @property
    def steady_timers(self) -> SteadyTimers:
        """The node's timers."""
        if self._steady_timers is None:
            self._steady_timers = SteadyTimers()
            super().create_timer(TICK_S, self._steady_timers.call_all, clock=Clock(clock_type=ClockType.STEADY_TIME))
        return self._steady_timers

    def create_timer(self, period: float, callback: Callable[[], object], *more: Any, **options: Any) -> Any:
        """A timer on the steady clock, with a resolution of :data:`TICK_S`; a faster one is the executor's own."""
        if period < TICK_S:
            return super().create_timer(period, callback, *more, **options)
        return self.steady_timers.add(period, callback)
