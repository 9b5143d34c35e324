"""A loop that runs in step with the messages of a stream, on the process's main thread."""

from __future__ import annotations

import time
from collections.abc import Callable

from straightcomp_ros.nodes.periodic import IDLE_EVERY_NS, exact_sleep
from straightcomp_ros.timing.histogram import Histogram
from straightcomp_ros.timing.report import OVERRUNS, TIMER_ERROR, written

_GAIN = 0.02


class LockedLoop:
    """A timer at a fixed rate that a stream's messages pull into their own frequency and phase.

    Each cycle begins when a message comes. One that does not come is waited for half a period beyond its time; then a
    cycle begins without it, and the next message is expected a period later. When that is follows from all earlier
    arrivals, by a first-order phase-locked loop.

    A timer alone, locked just behind the arrivals, must leave them room for their jitter: on a busy machine that is
    100 µs of latency, or a cycle that comes too early and looks again.

    Args:
        period_ns: length of a period.
        wait: ``wait(timeout_ns)`` returns when a message is there, or after that time.
        cycle: the work of one period; returns how many messages it found, and how long ago the newest came, in ns.
    """

    def __init__(self, period_ns: int, wait: Callable[[int], None], cycle: Callable[[], tuple[int, int]]) -> None:
        self._period_ns, self._wait, self._cycle = period_ns, wait, cycle
        self.overruns = 0
        """Periods without a cycle of their own: it came with the next one's."""
        self.idle_cycles = 0
        """Cycles that found no message."""
        self.phase_error_ns = 0.0
        """How much later than expected the newest message came."""
        self._lateness = Histogram()

    def report(self) -> dict[str, object]:
        """Values for the diagnostics: overruns, and how long after the arrival of its message, or after its time where
        none came, each cycle since the last report began."""
        return {
            OVERRUNS: self.overruns,
            "idle_cycles": self.idle_cycles,
            "phase_error_us": self.phase_error_ns * 1e-3,
            **written(TIMER_ERROR, self._lateness.take()),
        }

    def run(self, stopped: Callable[[], bool], idle: Callable[[], None]) -> None:
        """Loop until ``stopped()``; ``idle`` is called some 50 times a second, for work that can wait."""
        exact_sleep()
        period_ns, wait, cycle, record = self._period_ns, self._wait, self._cycle, self._lateness.record
        monotonic_ns, half_ns = time.monotonic_ns, self._period_ns // 2
        expected_ns = next_idle_ns = monotonic_ns()
        while not stopped():
            wait(max(0, expected_ns + half_ns - monotonic_ns()))
            now_ns = monotonic_ns()
            count, age_ns = cycle()
            if count:
                record(age_ns)
                self.overruns += count - 1
                error_ns = now_ns - age_ns - expected_ns
                self.phase_error_ns = float(error_ns)
                expected_ns += error_ns if abs(error_ns) > half_ns else round(_GAIN * error_ns)
            else:
                self.idle_cycles += 1
                missed = max(0, now_ns - expected_ns - half_ns) // period_ns
                record(max(0, now_ns - expected_ns - half_ns))
                self.overruns += missed
                expected_ns += missed * period_ns
            expected_ns += period_ns
            if now_ns >= next_idle_ns:
                idle()
                next_idle_ns = now_ns + IDLE_EVERY_NS
