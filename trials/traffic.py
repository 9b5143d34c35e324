"""Loads the logger: a process of its own publishes eight topics at 2 kHz, and the real node records them.

    python -m trials.traffic SECONDS

is that process.
"""

import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bench.processes import cores, usage
from straightcomp_ros.cell.launcher import Graph, LaunchError
from straightcomp_ros.contract import DEFAULT_RATE, DISPLACEMENT, POSITION, STREAMS

ON_REQUEST = (DISPLACEMENT, POSITION)
"""Topics that the logger records only on request (`other_topics`)."""
TRAFFIC = (*STREAMS, *ON_REQUEST)
_BEGUN, _ENDED = "publishing", "published"
"""Printed when every topic has a subscriber, and at the end, with the messages of each topic and the time in s."""
_LEAST_RATE = 0.95
"""Fraction of the rate below which the measurement does not represent a logger at that rate."""
_SETTLE_S = 1.0
"""Time for a discovered subscriber to be connected, and for the last messages to arrive and be fetched."""
_START_S = 60.0
_BATCH_S = 8.0 / DEFAULT_RATE
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
        command = [sys.executable, "-m", "trials.traffic", str(seconds)]
        traffic = graph.start_program("traffic", command, read_output=True)
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
    """The rest of the line that the process prints after a word."""
    assert process.stdout is not None
    for line in process.stdout:
        first, *others = line.split() or [""]
        if first == word:
            return others
    raise LaunchError(f"'traffic' ended: {graph.last_words('traffic')}")


def main(seconds: float) -> None:
    """Publish; after a stall the missed messages too, so that their number follows the time."""
    import rclpy
    from rclpy.node import Node

    from straightcomp_ros.runtime.middleware import own_profile
    from straightcomp_ros.runtime.streams import StreamPublisher

    with own_profile():
        rclpy.init()
        node = Node("traffic")
    publishers = [StreamPublisher(node, stream, at_once=True) for stream in TRAFFIC]
    noise, count, sent = random.Random(1), round(seconds * DEFAULT_RATE), 0
    rows = [[[noise.random() for _ in one.layout.columns] for _ in range(_ROWS)] for one in TRAFFIC]
    deadline = time.monotonic() + _START_S
    while missing := [one.topic for one in TRAFFIC if not node.count_subscribers(one.topic)]:
        if time.monotonic() > deadline:
            sys.exit(f"no subscriber of {', '.join(missing)}")
        time.sleep(_BATCH_S)
    time.sleep(_SETTLE_S)
    print(_BEGUN, flush=True)
    begin_ns, begin = time.time_ns(), time.monotonic()
    while sent < count:
        due = min(count, int((time.monotonic() - begin) * DEFAULT_RATE) + 1)
        for number in range(sent, due):
            for publish, numbers in zip(publishers, rows, strict=True):
                publish(begin_ns + number * 10**9 // DEFAULT_RATE, *numbers[number % _ROWS])
        sent = due
        time.sleep(_BATCH_S)
    print(_ENDED, count, time.monotonic() - begin, flush=True)
    time.sleep(_SETTLE_S)  # what the middleware still sends
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main(float(sys.argv[1]))
