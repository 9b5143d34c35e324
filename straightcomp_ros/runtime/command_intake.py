"""Handles the commands that reach the driver: writes each to the machine, drops it as stale, or trips."""

import math
from collections.abc import Callable

from straightcomp_ros.hardware.interface import Hardware
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.safety.watch import CommandWatch
from straightcomp_ros.timing.histogram import Histogram
from straightcomp_ros.timing.node_timing import LATENCY, written


class CommandIntake:
    """Writes valid commands to the machine, one for each sample.

    Args:
        hardware: the machine.
        timeout_ns: age in ns beyond which a command is stale.
        current_limit: largest current in A.
        trip: called with a fault and the reason in words.

    Attributes:
        current_limit: largest current in A; may be changed.
        stamp_ns: stamp of the newest sample that has its command.
    """

    def __init__(
        self, hardware: Hardware, timeout_ns: int, current_limit: float, trip: Callable[[Fault, str], None]
    ) -> None:
        self._hardware, self._timeout_ns, self._trip = hardware, timeout_ns, trip
        self.current_limit = current_limit
        self.stamp_ns = 0
        self._watch = CommandWatch()
        self._commands = self._stale = 0
        self._latency = math.nan
        self._latencies = Histogram()

    def accept(self, stamp_ns: int, current: float, arrival_ns: int) -> None:
        """Handle a command of ``current`` in A for the sample of ``stamp_ns``, received at ``arrival_ns``."""
        age_ns = arrival_ns - stamp_ns
        if stamp_ns <= self.stamp_ns:
            self._stale += 1
            finding = self._watch.again()
            if finding is not None:
                self._trip(*finding)
        elif age_ns > self._timeout_ns:
            self._stale += 1
        elif self.is_good(current):
            self._hardware.write(current, arrival_ns, stamp_ns)
            self.stamp_ns = stamp_ns
            self._latencies.record(age_ns)
            self.count(age_ns)
            self._watch.good()

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
            **written(LATENCY, self._latencies.take()),
        }
