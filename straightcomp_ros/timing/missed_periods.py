"""Missed periods of a loop, told apart by their cause: its own work took too long, or the host held it up."""

from straightcomp_ros.timing.node_timing import OVERRUNS, STALLED_MS, STALLS

_STALL_NS = 2_000_000
"""No cycle takes that long by its own work, at any rate."""


class MissedPeriods:
    """Counts overruns and stalls of a loop.

    Periods missed at once that last less than 2 ms together are overruns: the cycles took longer than a period. A
    longer gap is a stall: other programs, the kernel or the hypervisor had the CPU.

    Args:
        period_ns: of the loop.

    Attributes:
        overruns: missed periods, without those of stalls.
        stalls: gaps of 2 ms or more.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.overruns = self.stalls = self._stalled_ns = 0

    def count(self, missed: int) -> None:
        """Count ``missed`` periods that were missed at once, if any."""
        lasted_ns = missed * self._period_ns
        if lasted_ns >= _STALL_NS:
            self.stalls += 1
            self._stalled_ns += lasted_ns
        else:
            self.overruns += missed

    def report(self) -> dict[str, object]:
        """Values for the diagnostics, since the start."""
        return {OVERRUNS: self.overruns, STALLS: self.stalls, STALLED_MS: self._stalled_ns // 1_000_000}
