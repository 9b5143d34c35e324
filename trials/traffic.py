"""Loads the logger: a process of its own publishes eight topics at 2 kHz, in batches, and the real node records them.

    python -m trials.traffic --ros-args -p seconds:=20.0

is that process.
"""

import random
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bench.processes import cores, usage
from straightcomp_ros.cell.launcher import Graph, LaunchError
from straightcomp_ros.contract import DEFAULT_RATE, DISPLACEMENT, POSITION, STREAMS
from straightcomp_ros.parameters.declaration import group, parameter
from straightcomp_ros.timing.realtime import RealtimeParameters

ON_REQUEST = (DISPLACEMENT, POSITION)
"""Topics that the logger records only on request (`other_topics`)."""
TRAFFIC = (*STREAMS, *ON_REQUEST)
_BEGUN, _ENDED = "publishing", "published"
"""Printed when every topic has a subscriber, and at the end, with the messages of each topic and the time in s."""
_LEAST_RATE = 0.95
"""Fraction of the rate below which the measurement does not represent a logger at that rate."""
_SETTLE_S = 1.0
"""Time for a discovered subscriber to be connected, and for the last messages to arrive and be fetched."""
_PERIOD_NS = 1_000_000_000 // DEFAULT_RATE
_BATCH = 8
_ROWS = 1000
"""Number of different messages of each topic: noise, which costs a recording most, since it cannot be compressed."""


def record_traffic(work: Path, seconds: float) -> tuple[int, float]:
    """Record for ``seconds``; the bag is ``traffic`` in the folder ``work``.

    Returns:
        Number of published messages that the bag lacks, and number of CPU cores that the logger used.

    Raises:
        LaunchError: a node could not be started.
        BagError: the computer was too busy to publish at the rate.
    """
    bag = work / "traffic"
    others = "|".join(f"/{stream.topic}" for stream in ON_REQUEST)
    with Graph(work / "traffic_logs") as graph:
        logger = graph.start("logger", {"output": str(bag), "nodes": "logger", "other_topics": others})
        command = [sys.executable, "-m", "trials.traffic"]
        traffic = graph.start("traffic", {"seconds": float(seconds)}, command=command, read_output=True)
        _line_of(_BEGUN, graph, traffic)
        graph.check(("logger",))
        begin = usage({"logger": logger.pid})
        published, took = _line_of(_ENDED, graph, traffic)
        graph.check(("logger",))
        busy = cores(begin, usage({"logger": logger.pid}))["logger"]
        time.sleep(_SETTLE_S)
        graph.stop(("logger", "traffic"))
    rate = int(published) / float(took)
    if rate < _LEAST_RATE * DEFAULT_RATE:
        raise BagError(f"{rate:.0f} messages a second were published on each topic, not {DEFAULT_RATE}: measure again")
    return lost(bag, int(published)), busy


def lost(bag: Path, published: int) -> int:
    """How many messages of ``published`` a bag lacks on the topics of :data:`TRAFFIC`; none is counted twice."""
    streams = read_streams(bag, {stream.topic: stream.layout for stream in TRAFFIC})
    return len(TRAFFIC) * published - sum(len(np.unique(stream.stamp)) for stream in streams.values())


def _line_of(word: str, graph: Graph, process: subprocess.Popen[str]) -> list[str]:
    """The rest of the line that the node prints after a word."""
    assert process.stdout is not None
    # rclpy prints warnings of its executor there too.
    for line in process.stdout:
        first, *others = line.split() or [""]
        if first == word:
            return others
    raise LaunchError(f"node 'traffic' ended: {graph.last_words('traffic')}")


@dataclass(frozen=True)
class TrafficParameters:
    """Parameters of the node `traffic`."""

    seconds: float = parameter(20.0, "Time for which it publishes", "(0, inf) s")
    start_timeout: float = parameter(60.0, "Longest wait for a subscriber of each topic", "(0, inf) s")
    realtime: RealtimeParameters = group(RealtimeParameters)


def main() -> int:
    """Run the node."""
    from rclpy.node import Node
    from rclpy.task import Future

    from straightcomp_ros.runtime.loops import PeriodicLoop, from_monotonic
    from straightcomp_ros.runtime.ros_parameters import declare
    from straightcomp_ros.runtime.runner import EXIT_FAILURE, Runnable, run
    from straightcomp_ros.runtime.streams import StreamPublisher

    class Traffic(Runnable):
        """After a stall it publishes the missed messages, so that their number follows the time."""

        def __init__(self, node: Node) -> None:
            self._parameters = parameters = declare(node, TrafficParameters)
            self.node, self.done, self.realtime = node, Future(), parameters.realtime
            noise = random.Random(1)
            self._publishers = [StreamPublisher(node, stream, at_once=True) for stream in TRAFFIC]
            self._rows = [[[noise.random() for _ in one.layout.columns] for _ in range(_ROWS)] for one in TRAFFIC]
            self._count = round(parameters.seconds * DEFAULT_RATE)
            self._made, self._sent, self._begin_ns, self._end_ns = time.monotonic(), 0, 0, 0
            self.loop = PeriodicLoop(_BATCH * _PERIOD_NS, self._cycle)

        def _cycle(self, wake_ns: int) -> None:
            if not self._begin_ns:
                missing = [one.topic for one in TRAFFIC if not self.node.count_subscribers(one.topic)]
                if not missing:
                    self._begin_ns = wake_ns + round(_SETTLE_S * 1e9)
                elif time.monotonic() - self._made > self._parameters.start_timeout and not self.done.done():
                    self.node.get_logger().error(f"no subscriber of {', '.join(missing)}")
                    self.done.set_result(EXIT_FAILURE)
            elif self._sent < self._count:
                self._publish()
            elif wake_ns > self._end_ns + round(_SETTLE_S * 1e9) and not self.done.done():
                self.done.set_result(0)

        def _publish(self) -> None:
            due = min(self._count, (time.monotonic_ns() - self._begin_ns) // _PERIOD_NS + 1)
            if due > 0 and not self._sent:
                print(_BEGUN, flush=True)
            while self._sent < due:
                stamp_ns = from_monotonic(self._begin_ns + self._sent * _PERIOD_NS)
                for publish, rows in zip(self._publishers, self._rows, strict=True):
                    publish(stamp_ns, *rows[self._sent % _ROWS])
                self._sent += 1
            if self._sent == self._count:
                self._end_ns = time.monotonic_ns()
                print(_ENDED, self._count, (self._end_ns - self._begin_ns) * 1e-9, flush=True)

    return run("traffic", Traffic)


if __name__ == "__main__":
    sys.exit(main())
