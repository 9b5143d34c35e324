"""Loads the logger: the real node records eight topics at 2 kHz from a separate process."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bench.processes import cores, usage
from straightcomp_ros.cell.launcher import Graph, LaunchError
from straightcomp_ros.contract import DEFAULT_RATE, DISPLACEMENT, PACKAGE, POSITION, STREAMS

BESIDE_THE_STREAMS = (DISPLACEMENT, POSITION)
"""Topics that the logger records only on request (`other_topics`)."""
TRAFFIC = (*STREAMS, *BESIDE_THE_STREAMS)
"""What the node `traffic` publishes, each at :data:`DEFAULT_RATE`: 16,000 messages a second in all."""
BEGUN = "publishing"
"""Printed by the node when every topic has a subscriber and it begins."""
ENDED = "published"
"""Printed at its end, followed by the number of messages of each topic, and the time in s that they took."""
_LEAST_RATE = 0.95
"""Fraction of the rate below which the measurement does not represent a logger at that rate."""
_SETTLE_S = 1.0
"""Time for the logger to fetch the last messages."""


def record_traffic(work: Path, seconds: float) -> tuple[int, float]:
    """Record for ``seconds``; the bag is ``traffic`` in the folder ``work``.

    Returns:
        Number of published messages that the bag lacks, and number of CPU cores that the logger used.

    Raises:
        LaunchError: a node could not be started.
        BagError: the computer was too busy to publish at the rate.
    """
    bag = work / "traffic"
    others = "|".join(f"/{stream.topic}" for stream in BESIDE_THE_STREAMS)
    with Graph(work / "traffic_logs") as graph:
        logger = graph.start("logger", {"output": str(bag), "nodes": "logger", "other_topics": others})
        command = [sys.executable, "-m", f"{PACKAGE}.trials.bench.traffic_node"]
        traffic = graph.start("traffic", {"seconds": float(seconds)}, command=command, read_output=True)
        _said(BEGUN, graph, traffic)
        graph.check(("logger",))
        begin = usage({"logger": logger.pid})
        published, took = _said(ENDED, graph, traffic)
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


def _said(word: str, graph: Graph, process: subprocess.Popen[str]) -> list[str]:
    """The rest of the line that the node prints after a word."""
    assert process.stdout is not None
    # rclpy prints warnings of its executor there too.
    for line in process.stdout:
        first, *others = line.split() or [""]
        if first == word:
            return others
    raise LaunchError(f"node 'traffic' ended: {graph.last_words('traffic')}")
