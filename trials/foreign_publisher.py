"""Publishes commands as a node that is none of the graph's, for trials: at a rate and with stamps of its own.

    python -m trials.foreign_publisher RATE CLOCK OFFSET CURRENT

Rate in 1/s, 1 or 0 for stamps of the present time or of time 0, an offset to these in ns, the current in A. The time of
the first command in ns is printed. When standard input ends it does, too, and prints the number of commands.
"""

import select
import sys
import time

import rclpy
from rclpy.node import Node

from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.middleware import own_profile
from straightcomp_ros.runtime.streams import stream_publisher

_LOOK_S = 0.01
_SHORT_S = 1e-3
"""Waits shorter than this are busy: a sleeping process may wake up too late for 5000 commands in a second."""


def main(rate: float, clock: int, offset_ns: int, current: float) -> None:
    """Send commands until standard input ends."""
    with own_profile():
        rclpy.init()
        node = Node("foreign_publisher")
    publisher = stream_publisher(node, COMMAND)
    publish, pack = raw_publish(publisher), COMMAND.layout.pack
    # In a process with its controller no driver subscribes to commands, but it publishes.
    while not (publisher.get_subscription_count() or node.count_publishers(ENCODER.topic)):
        time.sleep(_LOOK_S)
    sent, due = 0, time.monotonic()
    while not _ended_within(0.0):
        now_ns = time.time_ns()
        publish(pack(clock * now_ns + offset_ns, current))
        if not sent:
            print(now_ns, flush=True)
        sent += 1
        due += 1.0 / rate
        while (left := due - time.monotonic()) > 0.0:
            if left > _SHORT_S and _ended_within(left - _SHORT_S):
                break
    print(sent, flush=True)
    # A publisher that ends without a word is known until its lease has run out.
    node.destroy_node()
    rclpy.shutdown()


def _ended_within(seconds: float) -> bool:
    return bool(select.select([sys.stdin], [], [], seconds)[0])


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
