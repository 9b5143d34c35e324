"""A loop that runs in step with the messages of a stream, on the process's main thread."""

import os
import time
from collections.abc import Callable, Sequence
from itertools import pairwise

from straightcomp_ros.runtime.periodic import IDLE_EVERY_NS, IdleWork
from straightcomp_ros.timing.histogram import Histogram
from straightcomp_ros.timing.node_timing import OVERRUNS, TIMER_ERROR, written

_GAIN = 0.02


class LockedLoop:
    """A loop whose cycles have the frequency and the phase of a stream: each begins when a message comes.

    A timer locked just behind the arrivals would have to leave them room for their jitter, 100 µs of latency on a busy
    machine, and to set the CPU's timer in each period, which in a virtual machine costs as much as the control law.
    When a message is due follows from the arrivals before it, by a first-order phase-locked loop: this tells how
    steadily they come. Without messages the loop only does its idle work.

    Args:
        period_ns: of the messages.
        wait: ``wait(timeout_ns)`` returns when a message is there, or after that time.
        cycle: the work of one period; returns how many messages it found, those that were sent together as one, and
            how long ago the newest came, in ns.
    """

    def __init__(self, period_ns: int, wait: Callable[[int], None], cycle: Callable[[], tuple[int, int]]) -> None:
        self._period_ns, self._wait, self._cycle = period_ns, wait, cycle
        self.overruns = 0
        """Messages without a cycle of their own: they were found together with one that was sent later."""
        self.phase_error_ns = 0.0
        """How much later than due the newest message came."""
        self._lateness = Histogram()

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: overruns, and how long after the arrival of its message each cycle since the last
        report began."""
        return {
            OVERRUNS: self.overruns,
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
                    self.overruns += count - 1
                    # At a real-time priority a loop that never waits would keep the middleware's threads from running.
                    os.sched_yield()
                due_ns = self._follow(now_ns - age_ns, due_ns) + period_ns
            # Without a message nothing is due.
            idle_turn(now_ns, due_ns - monotonic_ns() if count else period_ns)

    def _follow(self, arrival_ns: int, due_ns: int) -> int:
        """When the message should have come that came at ``arrival_ns``."""
        error_ns = arrival_ns - due_ns
        if abs(error_ns) > self._period_ns:
            due_ns, error_ns = arrival_ns, 0  # a new beginning: messages were lost, or their source was started anew
        self.phase_error_ns = float(error_ns)
        return due_ns + round(_GAIN * error_ns)


def sendings(sent_ns: Sequence[int], apart_ns: int) -> int:
    """How many times something was sent: messages less than ``apart_ns`` after the one before were sent together.

    A source that was late itself sends together what it missed; whoever receives it in one cycle was not late.

    Args:
        sent_ns: of each message, in the order of sending.
        apart_ns: in ns.
    """
    return sum(later - sooner >= apart_ns for sooner, later in pairwise(sent_ns)) + bool(sent_ns)
