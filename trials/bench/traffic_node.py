"""Publishes eight topics at 2 kHz, in batches: the load that `straightcomp bench bags` has the logger record.

python -m trials.bench.traffic_node --ros-args -p seconds:=20.0
"""

import random
import sys
import time
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.task import Future

from straightcomp_ros.contract import DEFAULT_RATE
from straightcomp_ros.parameters.declaration import group, parameter
from straightcomp_ros.runtime.loops import PeriodicLoop, from_monotonic
from straightcomp_ros.runtime.ros_parameters import declare
from straightcomp_ros.runtime.runner import EXIT_FAILURE, run
from straightcomp_ros.runtime.streams import publisher
from straightcomp_ros.timing.realtime import RealtimeParameters
from trials.bench.traffic_streams import BEGUN, ENDED, TRAFFIC

_PERIOD_NS = 1_000_000_000 // DEFAULT_RATE
_BURST = 8
"""Messages of a topic that are published in one batch."""
_SETTLE_NS = 1_000_000_000
"""Time for a discovered subscriber to be connected, and for the last messages to arrive."""
_LOOK_EVERY = 12
"""Cycles between two checks for subscribers."""
_ROWS = 1000
"""Number of different messages of each topic."""


@dataclass(frozen=True)
class TrafficParameters:
    """Parameters of the node `traffic`."""

    seconds: float = parameter(20.0, "Time for which it publishes", "(0, inf) s")
    start_timeout: float = parameter(60.0, "Longest wait for a subscriber of each topic", "(0, inf) s")
    realtime: RealtimeParameters = group(RealtimeParameters)


class TrafficNode:
    """Publishes noise, which costs a recording more than a machine's signals: it cannot be compressed.

    After a stall it publishes the missed messages, so that their number follows the time.
    """

    def __init__(self, node: Node) -> None:
        parameters = declare(node, TrafficParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        noise = random.Random(1)
        self._streams = [
            (
                stream,
                publisher(node, stream),
                [[noise.random() for _ in stream.layout.columns] for _ in range(_ROWS)],
            )
            for stream in TRAFFIC
        ]
        self._count = round(parameters.seconds * DEFAULT_RATE)
        self._timeout = parameters.start_timeout
        self._deadline = time.monotonic() + parameters.start_timeout
        self._sent = 0
        self._begin_ns: int | None = None
        self._end_ns = 0
        self.loop = PeriodicLoop(_BURST * _PERIOD_NS, self._cycle)

    def _cycle(self, wake_ns: int) -> None:
        if self._begin_ns is None:
            if self.loop.cycles % _LOOK_EVERY == 0:
                self._look(wake_ns)
        elif self._sent < self._count:
            self._publish(self._begin_ns)
        elif wake_ns > self._end_ns + _SETTLE_NS and not self.done.done():
            self.done.set_result(0)

    def _look(self, wake_ns: int) -> None:
        missing = [stream.topic for stream, _, _ in self._streams if not self.node.count_subscribers(stream.topic)]
        if not missing:
            self._begin_ns = wake_ns + _SETTLE_NS
        elif time.monotonic() > self._deadline and not self.done.done():
            self.node.get_logger().error(f"nobody subscribes to {', '.join(missing)} within {self._timeout:g} s")
            self.done.set_result(EXIT_FAILURE)

    def _publish(self, begin_ns: int) -> None:
        due = min(self._count, (time.monotonic_ns() - begin_ns) // _PERIOD_NS + 1)
        if due > 0 and not self._sent:
            print(BEGUN, flush=True)
        while self._sent < due:
            stamp_ns = from_monotonic(begin_ns + self._sent * _PERIOD_NS)
            for _, publish, rows in self._streams:
                publish(stamp_ns, *rows[self._sent % _ROWS])
            self._sent += 1
        if self._sent == self._count:
            self._end_ns = time.monotonic_ns()
            print(ENDED, self._count, (self._end_ns - begin_ns) * 1e-9, flush=True)

    def close(self) -> None:
        """There is nothing to make safe."""


def main() -> int:
    """Run the node."""
    return run("traffic", TrafficNode)


if __name__ == "__main__":
    sys.exit(main())
