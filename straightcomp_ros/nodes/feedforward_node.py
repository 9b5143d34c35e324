"""feedforward: encoder sample in, straightness reference for it out."""

from __future__ import annotations

import os
import sys

from rclpy.node import Node
from rclpy.task import Future

from straightcomp_ros.configuration import FeedforwardNodeParameters
from straightcomp_ros.contract import ENCODER, REFERENCE
from straightcomp_ros.nodes.declare import declare
from straightcomp_ros.nodes.diagnostics import Diagnostics
from straightcomp_ros.nodes.periodic import PeriodicLoop
from straightcomp_ros.nodes.runner import run
from straightcomp_ros.nodes.streams import Inbox, publisher, unspun_node
from straightcomp_ros.straightness.feedforward import Feedforward
from straightcomp_ros.straightness.map import load_map
from straightcomp_ros.timing.gaps import StampGaps
from straightcomp_ros.timing.report import LOST, SAMPLES


class FeedforwardNode:
    """Looks the reference up in the map for each sample, some samples at a time.

    The controller extrapolates an earlier reference, so nobody waits for this node.
    """

    def __init__(self, node: Node) -> None:
        parameters = declare(node, FeedforwardNodeParameters)
        self.node, self.done, self.realtime = node, Future(), parameters.realtime
        straightness = load_map(parameters.map)
        node.get_logger().info(f"map {parameters.map.file}: {straightness.report}")
        self._feedforward = Feedforward(straightness, parameters.feedforward)
        self._publish = publisher(node, REFERENCE)
        self._samples = 0
        self._gaps = StampGaps()
        self._inbox = Inbox(node, unspun_node(node), ENCODER)
        self.loop = PeriodicLoop(round(parameters.interval * 1e9), self._cycle)
        Diagnostics(node, self._counters)

    def _cycle(self, _: int) -> None:
        for stamp_ns, numbers, _ in self._inbox.fetch():
            self._samples += 1
            self._gaps.see(stamp_ns)
            self._publish(stamp_ns, *self._feedforward.step(stamp_ns, numbers[0]))
            # With real-time scheduling driver and controller would have to wait for the end of this.
            os.sched_yield()

    def _counters(self) -> dict[str, object]:
        return {SAMPLES: self._samples, LOST: self._gaps.lost, **self.loop.report()}

    def close(self) -> None:
        """Nothing to make safe."""


def main() -> int:
    """Entry point of `ros2 run straightcomp_ros feedforward_node`."""
    return run("feedforward", FeedforwardNode)


if __name__ == "__main__":
    sys.exit(main())
