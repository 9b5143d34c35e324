"""Publishes commands as a node that is none of the graph's, for trials: at a rate and with stamps of its own."""

import os
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

import rclpy
from rclpy.node import Node

from straightcomp_ros.contract import COMMAND, ENCODER
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.middleware import own_profile
from straightcomp_ros.runtime.streams import Streams, stream_publisher

_LOOK_S = 0.01
_SHORT_S = 1e-3
"""Waits shorter than this are busy: a sleeping process may wake up too late for 5000 commands in a second."""


def publish(pipe: Connection, *own: float) -> None:
    """Send commands until something comes through ``pipe``, which gets the time of the first in ns, and at the end
    their number. ``own``: rate in 1/s, 1 or 0 for stamps of the present time or of time 0, an offset to these in ns,
    the current in A; without these it repeats each command of the controller."""
    os.setsid()  # like another user's program
    with own_profile():
        rclpy.init()
        node = Node("foreign_publisher")
    publisher = stream_publisher(node, COMMAND)
    send, pack, sent = raw_publish(publisher), COMMAND.layout.pack, 0
    # In a process with its controller no driver subscribes to commands, but it publishes.
    while not (publisher.get_subscription_count() or node.count_publishers(ENCODER.topic)):
        time.sleep(_LOOK_S)
    for stamp_ns, current in _own(pipe, *own) if own else _repeated(pipe, node):
        now_ns = time.time_ns()
        send(pack(stamp_ns, current))
        if not sent:
            pipe.send(now_ns)
        sent += 1
    # A publisher that ends without a word is known until its lease has run out.
    node.destroy_node()
    rclpy.shutdown()
    pipe.send(sent)


def _own(pipe: Connection, rate: float, clock: float, offset_ns: float, current: float) -> Iterator[tuple[int, float]]:
    due = time.monotonic()
    while not pipe.poll():
        yield int(clock) * time.time_ns() + int(offset_ns), current
        due += 1.0 / rate
        while (left := due - time.monotonic()) > 0.0:
            if left > _SHORT_S and pipe.poll(left - _SHORT_S):
                break


def _repeated(pipe: Connection, node: Node) -> Iterator[tuple[int, float]]:
    commands = Streams(node).queue(COMMAND)
    while not pipe.poll(_SHORT_S):
        yield from ((stamp_ns, numbers[0]) for stamp_ns, numbers, _ in commands.fetch())
