"""Publishes commands as a node that is none of the graph's, for trials: at a rate and with stamps of its own.

    python -m trials.foreign_publisher RATE CLOCK OFFSET CURRENT
    python -m trials.foreign_publisher echo

Rate in 1/s, 1 or 0 for stamps of the present time or of time 0, an offset to these in ns, the current in A; with `echo`
it repeats each command of the controller. The time of the first command in ns is printed. When standard input ends it
does, too, and prints the number of commands.
"""

import select
import sys
import time
from collections.abc import Iterator

import rclpy
from rclpy.node import Node

from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.middleware import own_profile
from straightcomp_ros.runtime.streams import Streams, stream_publisher

_LOOK_S = 0.01
_SHORT_S = 1e-3
"""Waits shorter than this are busy: a sleeping process may wake up too late for 5000 commands in a second."""


def main(words: list[str]) -> None:
    """Send commands until standard input ends."""
    with own_profile():
        rclpy.init()
        node = Node("foreign_publisher")
    publisher = stream_publisher(node, COMMAND)
    publish, pack, sent = raw_publish(publisher), COMMAND.layout.pack, 0
    # In a process with its controller no driver subscribes to commands, but it publishes.
    while not (publisher.get_subscription_count() or node.count_publishers(ENCODER.topic)):
        time.sleep(_LOOK_S)
    for stamp_ns, current in _repeated(node) if words == ["echo"] else _own(*words):
        now_ns = time.time_ns()
        publish(pack(stamp_ns, current))
        if not sent:
            print(now_ns, flush=True)
        sent += 1
    print(sent, flush=True)
    # A publisher that ends without a word is known until its lease has run out.
    node.destroy_node()
    rclpy.shutdown()


def _own(rate: str, clock: str, offset_ns: str, current: str) -> Iterator[tuple[int, float]]:
    due = time.monotonic()
    while not _ended_within(0.0):
        yield int(clock) * time.time_ns() + int(offset_ns), float(current)
        due += 1.0 / float(rate)
        while (left := due - time.monotonic()) > 0.0:
            if left > _SHORT_S and _ended_within(left - _SHORT_S):
                break


def _repeated(node: Node) -> Iterator[tuple[int, float]]:
    commands = Streams(node).queue(COMMAND)
    while not _ended_within(_SHORT_S):
        yield from ((stamp_ns, numbers[0]) for stamp_ns, numbers, _ in commands.fetch())


def _ended_within(seconds: float) -> bool:
    return bool(select.select([sys.stdin], [], [], seconds)[0])


if __name__ == "__main__":
    main(sys.argv[1:])
