"""Handles the commands that reach the driver: writes each to the machine, drops it as stale, or trips."""

import math
from collections import deque
from collections.abc import Callable

from straightcomp_ros.hardware.interface import Hardware
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.watch import CommandWatch
from straightcomp_ros.timing.delays import Histogram
from straightcomp_ros.timing.node_timing import LATENCY, written

_SPARE = 4
"""Samples remembered beyond those of the timeout."""


class CommandIntake:
    """Writes valid commands to the machine: in the order of the samples that were handed out, one for each.

    A controller takes its stamps from these samples. A command with another stamp is from elsewhere, and one is enough
    for a fault; only before the first sample are there innocent ones, of a controller that answers a driver's former
    life. No accepted stamp is newer than the newest sample.

    Args:
        hardware: the machine.
        timeout_ns: age in ns beyond which a command is stale.
        period_ns: sampling period in ns.
        current_limit: largest current in A.
        trip: called with a fault and the reason in words.

    Attributes:
        current_limit: largest current in A; may be changed.
        stamp_ns: stamp of the newest sample that has its command; 0 without one.
    """

    def __init__(
        self,
        hardware: Hardware,
        timeout_ns: int,
        period_ns: int,
        current_limit: float,
        trip: Callable[[Fault, str], None],
    ) -> None:
        self._hardware, self._timeout_ns, self._trip = hardware, timeout_ns, trip
        self.current_limit = current_limit
        # The command for an older sample is stale anyway. A board's clock may be faster than its nominal period.
        self._recent: deque[int] = deque(maxlen=timeout_ns // period_ns + _SPARE)
        self._commands = self._stale = self._foreign = 0
        self._latency = math.nan
        self._latencies = Histogram()
        self.restart()

    def restart(self) -> None:
        """Forget samples and commands: sampling begins, or a fault is cleared."""
        self.stamp_ns = 0
        self._recent.clear()
        self._handed_out: set[int] = set()
        self._watch = CommandWatch()

    def hand_out(self, stamp_ns: int) -> None:
        """A sample is about to be published; stamps rise."""
        recent = self._recent
        if len(recent) == recent.maxlen:
            self._handed_out.discard(recent[0])
        recent.append(stamp_ns)
        self._handed_out.add(stamp_ns)

    def accept(self, stamp_ns: int, current: float, arrival_ns: int) -> None:
        """Handle a command of ``current`` in A for the sample of ``stamp_ns``, received at ``arrival_ns``."""
        age_ns = arrival_ns - stamp_ns
        if stamp_ns not in self._handed_out:
            self._refuse(stamp_ns, current)
        elif stamp_ns <= self.stamp_ns:
            self._stale += 1
            finding = self._watch.again(arrival_ns)
            if finding is not None:
                self._trip(*finding)
        elif age_ns > self._timeout_ns:
            self._stale += 1
        elif self.is_good(current):
            self._hardware.write(current, arrival_ns, stamp_ns)
            self.stamp_ns = stamp_ns
            self._latencies.record(age_ns)
            self.count(age_ns)

    def _refuse(self, stamp_ns: int, current: float) -> None:
        """Handle a command whose stamp is of no recent sample."""
        oldest_ns = self._recent[0] if self._recent else math.inf
        if self.stamp_ns < stamp_ns < oldest_ns:
            # A controller that was stopped answers what it received before, perhaps from a driver that has ended.
            self._stale += 1
            return
        self._foreign += 1
        if self.is_good(current):
            to_newest = (stamp_ns - self._recent[-1]) * 1e-9 if self._recent else math.nan
            words = f"a command for a sample that this driver did not take ({to_newest:+.6g} s from its newest)"
            self._trip(Fault.TWO_CONTROLLERS, f"{words}: another node publishes commands, or a second driver samples")

    def count(self, latency_ns: int) -> None:
        """Count a command written to the machine, ``latency_ns`` after its sample."""
        self._latency = latency_ns * 1e-9
        self._commands += 1

    def is_good(self, current: float) -> bool:
        """Whether a current may be written to the machine; trips if not."""
        limit = self.current_limit
        if -limit <= current <= limit:
            return True
        fault = Fault.COMMAND_OUT_OF_RANGE if math.isfinite(current) else Fault.COMMAND_NOT_FINITE
        self._trip(fault, f"command of {current} A is outside ±{limit:g} A")
        return False

    def take_latency(self) -> float:
        """Time in s from its sample to the last command; NaN if none has arrived since the last call."""
        latency, self._latency = self._latency, math.nan
        return latency

    def counters(self) -> dict[str, object]:
        """Values for the diagnostics, with the latencies since the last call."""
        return {
            "commands": self._commands,
            "stale_commands": self._stale,
            "foreign_commands": self._foreign,
            **written(LATENCY, self._latencies.take()),
        }
