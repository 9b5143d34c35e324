"""Streams in batches: the same messages, eight in one, for readers that can wait.

To publish a message, to wake its reader and to take it costs either side some 20 µs, more than all else about it. The
controller's samples and the driver's commands must come one by one. Whoever only records, looks on or looks ahead takes
the batches, and leaves the loop alone; a stream that nobody acts on is published one by one only where somebody has
subscribed to it.
"""

import itertools
import time
from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

from straightcomp_ros.contract import Stream
from straightcomp_ros.messages.batch import pack_batch, unpack_batch
from straightcomp_ros.messages.cdr import LayoutMismatch, header_stamp_ns
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.streams import (
    Messages,
    RawQueue,
    message_type,
    stream_publisher,
    stream_qos,
)

_BATCH = 8
"""Messages of a batch: 4 ms at 2 kHz."""
_LONGEST = 64
"""The same after a stall, when many wait: what loopback sockets take in one packet."""
_first_batches = itertools.cycle((1, 4, 7, 2, 5, 8, 3, 6))
"""Lengths of the first batches of a process's streams: those of a node must not all fall into the same cycle."""
_FLUSH_S = 0.5
"""For the last samples, when no more come: a batch that nothing fills waits for so long at most."""
_DELIVERY = Duration(seconds=0.2)
"""For readers to say that they have the last batches; one that stands still is not waited for any longer."""
_LOOK_NS = 200_000_000
_LONGEST_DELAY_NS = 1_000_000_000


class _Batches:
    """What goes out in batches: serialised messages, and when each was made."""

    def __init__(self, node: Node, stream: Stream) -> None:
        self._publisher = node.create_publisher(UInt8MultiArray, stream.batch_topic, stream_qos(reliable=True))
        self._publish = raw_publish(self._publisher)
        self._waiting: list[tuple[int, bytes]] = []
        self._room = next(_first_batches)

    @property
    def full(self) -> bool:
        """Whether the batch has all its messages."""
        return self._room <= 0

    def add(self, data: bytes) -> None:
        self._waiting.append((time.time_ns(), data))
        self._room -= 1

    def flush(self) -> list[tuple[int, bytes]]:
        """Publish what waits, and return it."""
        waiting, self._waiting = self._waiting, []
        if self._room <= 0:
            self._room = _BATCH
        for first in range(0, len(waiting), _LONGEST):
            self._publish(pack_batch(waiting[first : first + _LONGEST]))
        return waiting

    def delivered(self) -> None:
        """Wait until the readers have what was published: a reader that learns first of its writer's end drops it."""
        self._publisher.wait_for_all_acked(_DELIVERY)


class BatchPublisher:
    """A stream that nobody acts on at once: in batches, and one by one while somebody subscribes to it.

    Args:
        node: publishes.
        stream: what it publishes.
        flushed: the caller flushes, and nothing goes out between.
    """

    def __init__(self, node: Node, stream: Stream, flushed: bool = False) -> None:
        self._pack, self._flushed = stream.layout.pack, flushed
        self._batches = _Batches(node, stream)
        self._publisher = stream_publisher(node, stream)
        self._publish = raw_publish(self._publisher)
        if not flushed:
            node.create_timer(_FLUSH_S, self.flush)

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Publish one message, now or with those that follow it."""
        self._batches.add(self._pack(stamp_ns, *numbers))
        if self._batches.full and not self._flushed:
            self.flush()

    def flush(self) -> None:
        """Publish what waits."""
        messages = self._batches.flush()
        if messages and self._publisher.get_subscription_count():
            for _, data in messages:
                self._publish(data)

    def finish(self) -> None:
        """Publish what waits, and see it delivered: before the node ends."""
        self.flush()
        self._batches.delivered()


class CopiedPublisher:
    """A stream that somebody waits for: each message at once, and a little later in a batch.

    Args:
        node: publishes.
        stream: what it publishes.
        copied: false for no batches: where the next message may depend on the answer of somebody who reads them.
    """

    def __init__(self, node: Node, stream: Stream, copied: bool) -> None:
        self._pack, self._publish = stream.layout.pack, raw_publish(stream_publisher(node, stream))
        self._batches = _Batches(node, stream) if copied else None
        if copied:
            node.create_timer(_FLUSH_S, self.flush)

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Publish one message."""
        data = self._pack(stamp_ns, *numbers)
        self._publish(data)
        if self._batches is not None:
            self._batches.add(data)

    def copy(self) -> None:
        """Publish the batch if it is full: when those who wait for the messages have got them."""
        if self._batches is not None and self._batches.full:
            self._batches.flush()

    def flush(self) -> None:
        """Publish what no batch has had yet."""
        if self._batches is not None:
            self._batches.flush()

    def finish(self) -> None:
        """The same, and see it delivered: before the node ends."""
        if self._batches is not None:
            self._batches.flush()
            self._batches.delivered()


class BatchQueue:
    """Messages of a stream from its batches, or from the stream itself as long as nobody publishes any.

    Args:
        node: resolves the names.
        unspun: from :func:`straightcomp_ros.runtime.streams.unspun_node`.
        stream: what to receive.
        depth: messages, or batches, that may wait.
        complete: whatever is lost on the way is asked for again.
    """

    def __init__(self, node: Node, unspun: Node, stream: Stream, depth: int = 1000, complete: bool = False) -> None:
        def queue(kind: type, topic: str, reliable: bool = False) -> RawQueue:
            return RawQueue(unspun, kind, node.resolve_topic_name(topic), stream_qos(depth, reliable))

        kind = message_type(stream.layout.type_name)
        self._make_direct: Callable[[], RawQueue] = lambda: queue(kind, stream.topic)
        self._node, self._stream = node, stream
        self._batches = queue(UInt8MultiArray, stream.batch_topic, complete)
        self._direct: RawQueue | None = self._make_direct()
        self._warned = False
        self._newest_ns: int | None = None
        """Stamp of the last message that came directly; those of batches up to it have been had."""
        self._looked_ns = 0

    @property
    def connected(self) -> bool:
        """Whether a publisher is there, and the middleware has connected it."""
        return self._batches.connected or (self._direct is not None and self._direct.connected)

    def fetch(self) -> Messages:
        """Messages since the last call, each once."""
        if self._direct is None:
            self._look()
        copies = self._unpacked(self._batches.fetch())
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

    def _unpacked(self, batches: Messages) -> Messages:
        """The messages, with the time at which each was made as that of its source."""
        size, messages = self._stream.layout.size, Messages()
        for batch, info in batches:
            received_ns = info["received_timestamp"]
            try:
                messages += [
                    (data, {"received_timestamp": received_ns, "source_timestamp": made_ns})
                    for made_ns, data in unpack_batch(batch, size)
                ]
            except LayoutMismatch as error:
                if not self._warned:
                    self._node.get_logger().warning(f"batches on '{self._stream.batch_topic}' are dropped: {error}")
                    self._warned = True
        return messages

    @staticmethod
    def _came_directly(stamp_ns: int, newest_ns: int) -> bool:
        # Batches are late by some milliseconds: one that seems later is of another source, with another clock.
        return 0 <= newest_ns - stamp_ns < _LONGEST_DELAY_NS

    def _look(self) -> None:
        """Now and then: is the batches' publisher still there?"""
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = now_ns
            if not self._batches.connected:
                self._direct = self._make_direct()
