"""A loop that runs in step with the messages of a stream, on the process's main thread."""

import os
import time
from collections.abc import Callable, Sequence
from itertools import pairwise

from straightcomp_ros.runtime.periodic import IDLE_EVERY_NS, IdleWork
from straightcomp_ros.timing.delays import Histogram
from straightcomp_ros.timing.node_timing import TIMER_ERROR, MissedPeriods, written

_GAIN = 0.02


class LockedLoop:
    """A loop with the frequency and the phase of a stream: a cycle begins when a message arrives.

    A timer locked behind the arrivals would need a margin for their jitter, 100 µs of latency on a busy machine, and
    would set the CPU's timer in each period, which in a virtual machine costs as much as the control law. A first-order
    phase-locked loop predicts each arrival from those before; its error shows how steadily messages arrive. Without
    messages the loop only does its idle work.

    Args:
        period_ns: period of the messages.
        wait: ``wait(timeout_ns)`` returns when a message has arrived, or after that time.
        cycle: the work of one period; returns the number of messages found, where those sent together count as one, and
            the age of the newest in ns.
    """

    def __init__(self, period_ns: int, wait: Callable[[int], None], cycle: Callable[[], tuple[int, int]]) -> None:
        self._period_ns, self._wait, self._cycle = period_ns, wait, cycle
        self.missed = MissedPeriods(period_ns)
        """Messages without a cycle of their own, because a cycle found a later one too."""
        self.phase_error_ns = 0.0
        """How much later than predicted the newest message arrived."""
        self._lateness = Histogram()

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: missed periods, and the delays from a message's arrival to its cycle since the
        last report."""
        return {
            **self.missed.report(),
            "phase_error_us": self.phase_error_ns * 1e-3,
            **written(TIMER_ERROR, self._lateness.take()),
        }

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None]) -> None:
        """Loop until ``stopped()``; ``idle`` is called some 150 times a second, for work that can wait."""
        period_ns, wait, cycle, record = self._period_ns, self._wait, self._cycle, self._lateness.record
        monotonic_ns = time.monotonic_ns
        due_ns = monotonic_ns()
        idle_turn = IdleWork(idle, due_ns, period_ns)
        while not stopped():
            wait(IDLE_EVERY_NS)
            now_ns = monotonic_ns()
            count, age_ns = cycle()
            if count:
                record(age_ns)
                if count > 1:
                    self.missed.count(count - 1)
                    # At a real-time priority a loop that never waits would keep the middleware's threads from running.
                    os.sched_yield()
                due_ns = self._follow(now_ns - age_ns, due_ns) + period_ns
            # Without a message no cycle is due: the idle work has the whole period.
            idle_turn(now_ns, due_ns - monotonic_ns() if count else period_ns)

    def _follow(self, arrival_ns: int, due_ns: int) -> int:
        """The corrected time at which the message received at ``arrival_ns`` was due."""
        error_ns = arrival_ns - due_ns
        if abs(error_ns) > self._period_ns:
            due_ns, error_ns = arrival_ns, 0  # restart: messages were lost, or their source restarted
        self.phase_error_ns = float(error_ns)
        return due_ns + round(_GAIN * error_ns)


def sendings(sent_ns: Sequence[int], apart_ns: int) -> int:
    """The number of separate sends: a message less than ``apart_ns`` after its predecessor was sent together with it.

    A source that was late sends the messages it missed together. A receiver that gets them in one cycle was not late.

    Args:
        sent_ns: time at which each message was sent, in ns, ascending.
        apart_ns: smallest time between separate sends, in ns.
    """
    return sum(later - sooner >= apart_ns for sooner, later in pairwise(sent_ns)) + bool(sent_ns)
