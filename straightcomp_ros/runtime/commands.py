"""What the driver does with commands: it checks and writes each; in lockstep each brings the next sample."""

import math
from collections import deque
from collections.abc import Callable

from rclpy.node import Node

from straightcomp_ros.hardware.interface import Hardware, HardwareError, Sample, Truth
from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.timing.delays import Histogram
from straightcomp_ros.timing.node_timing import LATENCY, written

_SPARE = 4
"""Samples remembered beyond those of the timeout."""
_REPEATS, _REPEATS_WITHIN_NS = 4, 10_000_000_000
"""Commands for samples already answered that are a fault, and the time in ns within which they come. A controller sends
one command for each sample, in order, but the middleware might repeat one; good commands do not cancel repeated ones,
or a slow second controller would never be found."""
_REPEAT_AFTER_S = 0.05


class CommandIntake:
    """Writes valid commands to the machine: in the order of the samples that were handed out, one for each.

    A controller takes its stamps from these samples. A command with another stamp is from elsewhere, and one is enough
    for a fault; only before the first sample are there innocent ones, of a controller that answers a driver's former
    life. No accepted stamp is newer than the newest sample. A command older than ``timeout_ns`` is stale; ``trip`` is
    called with a fault and the reason in words.

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
        # Newest first: that is the one to be found. The command for an older sample than these is stale anyway. A
        # board's clock may be faster than its nominal period.
        self._recent: deque[int] = deque(maxlen=timeout_ns // period_ns + _SPARE)
        self._commands = self._stale = self._foreign = 0
        self._latency = math.nan
        self._latencies = Histogram()
        self.restart()

    def restart(self) -> None:
        """Forget samples and commands: sampling begins, or a fault is cleared."""
        self.stamp_ns = 0
        self._recent.clear()
        self._repeats_ns: deque[int] = deque(maxlen=_REPEATS)

    def hand_out(self, stamp_ns: int) -> None:
        """A sample is about to be published; stamps rise."""
        self._recent.appendleft(stamp_ns)

    def accept(self, stamp_ns: int, current: float, arrival_ns: int) -> None:
        """Handle a command of ``current`` in A for the sample of ``stamp_ns``, received at ``arrival_ns``."""
        age_ns = arrival_ns - stamp_ns
        if stamp_ns not in self._recent:
            self._refuse(stamp_ns, current)
        elif stamp_ns <= self.stamp_ns:
            self._stale += 1
            repeats_ns = self._repeats_ns
            repeats_ns.append(arrival_ns)
            if len(repeats_ns) == _REPEATS and arrival_ns - repeats_ns[0] <= _REPEATS_WITHIN_NS:
                repeats_ns.clear()
                self._trip(Fault.TWO_CONTROLLERS, "samples are answered twice: another node publishes commands too")
        elif age_ns > self._timeout_ns:
            self._stale += 1
        elif self.is_good(current):
            self._hardware.write(current, arrival_ns, stamp_ns)
            self.stamp_ns = stamp_ns
            self._latencies.record(age_ns)
            self.count(age_ns)

    def _refuse(self, stamp_ns: int, current: float) -> None:
        """Handle a command whose stamp is of no recent sample."""
        oldest_ns = self._recent[-1] if self._recent else math.inf
        if self.stamp_ns < stamp_ns < oldest_ns:
            # A controller that was stopped answers what it received before, perhaps from a driver that has ended.
            self._stale += 1
            return
        self._foreign += 1
        if self.is_good(current):
            to_newest = (stamp_ns - self._recent[0]) * 1e-9 if self._recent else math.nan
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


class Lockstep:
    """Advances the simulated machine by one sample at a time, from the stage trajectory's start to its end: it takes
    the next sample when the command for the last has arrived.

    The graph then computes exactly what `straightcomp simulate` computes, however slow or busy the computer is. The
    streams are best effort, so a message may be lost: a sample without an answer is sent again, and feedforward and
    controller answer a repeated sample as they did before. No other code may read ``hardware``; ``delay`` is that of a
    command from its sample, in periods.
    """

    def __init__(
        self,
        node: Node,
        hardware: Hardware,
        period_ns: int,
        delay: float,
        publish: Callable[[Sample, Truth | None], None],
    ) -> None:
        self.delay_ns = round(delay * period_ns)
        self._hardware, self._period_ns, self._publish = hardware, period_ns, publish
        self._pending: tuple[Sample, Truth | None] | None = None
        self._repeat = False
        node.create_timer(_REPEAT_AFTER_S, self._repeat_pending)

    def check_free(self) -> None:
        """Raise HardwareError if a trajectory is running."""
        if self._pending:
            raise HardwareError("in lockstep a trajectory runs to its end before the next may start")

    def start(self, trajectory: Trajectory, now_ns: int) -> None:
        """Start the trajectory at the machine's first sample, and take that sample; raises as :meth:`Hardware.move`."""
        self._hardware.start(now_ns)
        self._hardware.move(trajectory, now_ns)
        self._take(now_ns)

    def awaits(self, stamp_ns: int) -> bool:
        """Whether a command with this stamp answers the last sample."""
        return self._pending is not None and self._pending[0].stamp_ns == stamp_ns

    def answer(self, stamp_ns: int, current: float) -> None:
        """Apply the command for the last sample, of ``stamp_ns``, after the delay, and take the next sample."""
        self._hardware.write(current, stamp_ns + self.delay_ns)
        self._pending = None
        if self._hardware.motion.lasts(self._period_ns):
            self._take(stamp_ns + self._period_ns)

    def _take(self, at_ns: int) -> None:
        self._pending = self._hardware.read(at_ns)[-1]
        self._repeat = False
        self._publish(*self._pending)

    def _repeat_pending(self) -> None:
        # Send a sample again only after it has waited for a whole timer period.
        if self._pending and self._repeat:
            self._publish(*self._pending)
        self._repeat = True
