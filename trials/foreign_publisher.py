"""Publishes commands as a node that is none of the graph's, for trials: at a rate and with stamps of its own.

    python -m trials.foreign_publisher

A line on standard input begins: rate in 1/s, 1 or 0 for stamps of the present time or of time 0, an offset to these in
ns, the current in A. The time of the first command in ns is printed. The next line ends, and their number is printed.
"""

import select
import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.node import Node

from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.middleware import own_profile
from straightcomp_ros.runtime.streams import stream_publisher

_LOOK_S = 0.01
_SHORT_S = 1e-3
"""Waits shorter than this are busy: a sleeping process may wake up too late for 5000 commands in a second."""


def publish(send: Callable[[int, float], None], rate: float, clock: int, offset_ns: int, current: float) -> None:
    """Send commands until a line comes."""
    sent, due = 0, time.monotonic()
    while not _line_within(0.0):
        now_ns = time.time_ns()
        send(clock * now_ns + offset_ns, current)
        if not sent:
            print(now_ns, flush=True)
        sent += 1
        due += 1.0 / rate
        while (left := due - time.monotonic()) > 0.0:
            if left > _SHORT_S and _line_within(left - _SHORT_S):
                break
    sys.stdin.readline()
    print(sent, flush=True)


def _line_within(seconds: float) -> bool:
    return bool(select.select([sys.stdin], [], [], seconds)[0])


def main() -> None:
    """Run until standard input ends."""
    with own_profile():
        rclpy.init()
        node = Node("foreign_publisher")
    publisher = stream_publisher(node, COMMAND)
    publish_bytes, pack = raw_publish(publisher), COMMAND.layout.pack
    while line := sys.stdin.readline():
        rate, clock, offset_ns, current = line.split()
        # In a process with its controller no driver subscribes to commands, but it publishes.
        while not (publisher.get_subscription_count() or node.count_publishers(ENCODER.topic)):
            time.sleep(_LOOK_S)
        publish(
            lambda stamp_ns, current: publish_bytes(pack(stamp_ns, current)),
            float(rate),
            int(clock),
            int(offset_ns),
            float(current),
        )
    # A publisher that ends without a word is known until its lease has run out.
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
