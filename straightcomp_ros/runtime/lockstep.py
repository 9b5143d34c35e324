"""Runs the simulated machine one sample at a time: it takes the next sample when the command for the last has arrived.

The graph then computes exactly what `straightcomp simulate` computes, however slow or busy the computer is.
The streams are best effort, so a message may be lost: a sample without an answer is sent again, and feedforward and
controller answer a repeated sample as they did before.
"""

from collections.abc import Callable

from rclpy.node import Node

from straightcomp_ros.hardware.interface import Hardware, HardwareError, Sample, Truth
from straightcomp_ros.model.motion import Trajectory

_REPEAT_AFTER_S = 0.05


class Lockstep:
    """Advances the machine by one sampling period at a time, from the stage trajectory's start to its end.

    Args:
        node: provides the timer for repetitions.
        hardware: the machine; no other code may read it.
        period_ns: sampling period.
        delay: command delay from the sample, in periods.
        publish: publishes a sample.
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
        self._hardware = hardware
        self._period_ns = period_ns
        self._publish = publish
        self._end_ns = 0
        self._pending: tuple[Sample, Truth | None] | None = None
        self._repeat = False
        node.create_timer(_REPEAT_AFTER_S, self._repeat_pending)

    def start(self, trajectory: Trajectory, now_ns: int) -> None:
        """Start the trajectory at the machine's first sample, and take that sample.

        Raises:
            HardwareError: a trajectory is running already.
        """
        if self._pending:
            raise HardwareError("in lockstep a trajectory runs to its end before the next may start")
        self._hardware.start(now_ns)
        self._hardware.move(trajectory, now_ns)
        self._end_ns = now_ns + trajectory.end_ns
        self._take(now_ns)

    def awaits(self, stamp_ns: int) -> bool:
        """Whether a command with this stamp answers the last sample."""
        return self._pending is not None and self._pending[0].stamp_ns == stamp_ns

    def answer(self, current: float) -> None:
        """Apply the command for the last sample after the delay, and take the next sample."""
        if self._pending is None:
            return
        stamp_ns = self._pending[0].stamp_ns
        self._hardware.write(current, stamp_ns + self.delay_ns)
        self._pending = None
        if stamp_ns + self._period_ns < self._end_ns:
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
