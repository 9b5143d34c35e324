"""Copies of streams for readers that can wait: the same messages, published in bursts.

To wake a reader that sleeps costs the writer and the reader some 20 µs each, more than all else about a message. The
controller's samples and the driver's commands must come one by one; whoever only records or looks ahead takes them
eight at a time from a topic of their own, and leaves the loop alone.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import QoSProfile

from straightcomp_ros.cdr import header_stamp_ns
from straightcomp_ros.contract import Stream
from straightcomp_ros.nodes.streams import BurstPublisher, Messages, RawQueue, message_type, publisher

_LOOK_S = 0.2
_LONGEST_DELAY_NS = 1_000_000_000


class CopiedPublisher:
    """Publishes a stream, and its copy a little later.

    Args:
        node: publishes.
        stream: one with a copy.
        copied: false for no copy: where the next message may depend on the answer of somebody who reads copies.
    """

    def __init__(self, node: Node, stream: Stream, copied: bool) -> None:
        self._publish = publisher(node, stream)
        self._copies = BurstPublisher(node, stream, stream.copy_topic) if copied else None
        self._uncopied: list[bytes] = []

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Publish one message."""
        self._uncopied.append(self._publish(stamp_ns, *numbers))

    def copy(self) -> None:
        """Copy what was published since the last call: when those who wait for it have got it."""
        if self._copies is not None:
            for data in self._uncopied:
                self._copies.add(data)
        self._uncopied.clear()

    def flush(self) -> None:
        """Publish what the copy still lacks."""
        self.copy()
        if self._copies is not None:
            self._copies.flush()


class CopiedQueue:
    """Messages of a stream from its copy, or from the stream itself as long as nobody publishes a copy.

    Args:
        node: resolves the names, and looks now and then whether the copy's publisher is still there.
        unspun: from :func:`straightcomp_ros.nodes.streams.unspun_node`.
        stream: one with a copy.
        qos: of the subscriptions.
    """

    def __init__(self, node: Node, unspun: Node, stream: Stream, qos: QoSProfile | None = None) -> None:
        def queue(topic: str) -> RawQueue:
            return RawQueue(unspun, message_type(stream.layout.type_name), node.resolve_topic_name(topic), qos)

        self._make_direct: Callable[[], RawQueue] = lambda: queue(stream.topic)
        self._copy = queue(stream.copy_topic)
        self._direct: RawQueue | None = self._make_direct()
        self._newest_ns: int | None = None
        """Stamp of the last message that came directly; copies up to it have been had."""
        node.create_timer(_LOOK_S, self._look)

    @property
    def connected(self) -> bool:
        """Whether a publisher is there, and the middleware has connected it."""
        return self._copy.connected or (self._direct is not None and self._direct.connected)

    def fetch(self) -> Messages:
        """Messages since the last call, each once."""
        copies = self._copy.fetch()
        messages: Messages = []
        if self._direct is not None:
            messages = self._direct.fetch()
            if messages:
                self._newest_ns = header_stamp_ns(messages[-1][0])
            if copies:
                self._direct.close()
                self._direct = None
        if copies and self._newest_ns is not None:
            copies = [copy for copy in copies if not self._came_directly(header_stamp_ns(copy[0]), self._newest_ns)]
            if copies:
                self._newest_ns = None
        return messages + copies

    @staticmethod
    def _came_directly(stamp_ns: int, newest_ns: int) -> bool:
        # Copies are late by some milliseconds: one that seems later is of another source, with another clock.
        return 0 <= newest_ns - stamp_ns < _LONGEST_DELAY_NS

    def _look(self) -> None:
        if self._direct is None and not self._copy.connected:
            self._direct = self._make_direct()
