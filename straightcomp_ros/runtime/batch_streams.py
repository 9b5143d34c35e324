"""Streams in batches: the messages of some milliseconds in one, for subscribers that can wait.

Publishing a message, waking its subscriber and taking it costs each side about 20 µs, more than all other work on it.
The controller's samples and the driver's commands must arrive one by one. Subscribers that record, display or look
ahead take the batches and cost the loop little. A stream that no control loop waits for is published one by one only
while it has a subscriber.
"""

import itertools
import time
from collections.abc import Callable

from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

from straightcomp_ros.contract import Stream
from straightcomp_ros.messages.cdr import SHORTEST, LayoutMismatch, header_stamp_ns, pack_batch, unpack_batch
from straightcomp_ros.runtime.guarded_node import Complaints
from straightcomp_ros.runtime.inside_rclpy import raw_publish
from straightcomp_ros.runtime.streams import (
    Messages,
    RawQueue,
    SubscriptionQueue,
    message_type,
    stream_publisher,
    stream_qos,
)

BATCH_S, LOOK_AHEAD_S = 0.004, 0.002
"""Length of a batch for subscribers that record or display, and for the feedforward, which looks ahead."""
_LONGEST = 64
"""Messages in the largest batch, after a stall: it fits into one packet of a loopback socket."""
_first_batches = itertools.cycle((0.125, 0.5, 0.875, 0.25, 0.625, 1.0, 0.375, 0.75))
"""Lengths of the first batches of a process's streams, relative to the later ones: its batches must not all be
published in the same cycle."""
_FLUSH_S = 0.5
"""Longest time for which an incomplete batch waits for more messages."""
_DELIVERY = Duration(seconds=0.2)
"""Longest wait for subscribers to acknowledge the last batches."""
_LOOK_NS = 200_000_000
_LONGEST_DELAY_NS = 1_000_000_000


class _Batches:
    """Collects serialised messages with the time each was made, and publishes them in batches."""

    def __init__(self, node: Node, stream: Stream, length: float) -> None:
        self._publisher = node.create_publisher(UInt8MultiArray, stream.batch_topic, stream_qos(reliable=True))
        self._publish = raw_publish(self._publisher)
        self._waiting: list[tuple[int, bytes]] = []
        self._length = max(1, round(length))
        self._room = max(1, round(self._length * next(_first_batches)))

    @property
    def full(self) -> bool:
        """Whether the batch is complete."""
        return self._room <= 0

    def add(self, data: bytes) -> None:
        self._waiting.append((time.time_ns(), data))
        self._room -= 1

    def flush(self) -> list[tuple[int, bytes]]:
        """Publish the collected messages, and return them."""
        waiting, self._waiting = self._waiting, []
        if self._room <= 0:
            self._room = self._length
        for first in range(0, len(waiting), _LONGEST):
            self._publish(pack_batch(waiting[first : first + _LONGEST]))
        return waiting

    def delivered(self) -> None:
        """Wait for acknowledgement: a subscriber that first learns that its publisher has ended drops the messages."""
        self._publisher.wait_for_all_acked(_DELIVERY)


class BatchPublisher:
    """Publishes a stream that no control loop waits for: in batches, and one by one while it has a subscriber.

    Args:
        node: creates the publishers.
        stream: what to publish.
        rate: messages per second; None: publish only when the caller flushes.
    """

    def __init__(self, node: Node, stream: Stream, rate: float | None) -> None:
        self._pack, self._flushed = stream.layout.pack, rate is None
        self._batches = _Batches(node, stream, BATCH_S * (rate or 0.0))
        self._publisher = stream_publisher(node, stream)
        self._publish = raw_publish(self._publisher)
        if rate is not None:
            node.create_timer(_FLUSH_S, self.flush)

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Publish one message, now or in a batch with later ones."""
        self._batches.add(self._pack(stamp_ns, *numbers))
        if self._batches.full and not self._flushed:
            self.flush()

    def flush(self) -> None:
        """Publish the collected messages."""
        messages = self._batches.flush()
        if messages and self._publisher.get_subscription_count():
            for _, data in messages:
                self._publish(data)

    def finish(self) -> None:
        """Publish the collected messages and wait for their delivery; call it before the node ends."""
        self.flush()
        self._batches.delivered()


class CopiedPublisher:
    """Publishes a stream that a control loop waits for: each message at once, and again in a batch a little later.

    Args:
        node: creates the publishers.
        stream: what to publish.
        rate: messages per second; None: publish no batches. In lockstep the next message waits for the answer to the
            last one, so a batch would never fill.
        seconds: length of a batch.
    """

    def __init__(self, node: Node, stream: Stream, rate: float | None, seconds: float = BATCH_S) -> None:
        self._pack, self._publish = stream.layout.pack, raw_publish(stream_publisher(node, stream))
        self._batches = _Batches(node, stream, rate * seconds) if rate is not None else None
        if rate is not None:
            node.create_timer(_FLUSH_S, self.flush)

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Publish one message."""
        data = self._pack(stamp_ns, *numbers)
        self._publish(data)
        if self._batches is not None:
            self._batches.add(data)

    def copy(self) -> None:
        """Publish the batch if it is complete; call it after the control loop has got its message."""
        if self._batches is not None and self._batches.full:
            self._batches.flush()

    def flush(self) -> None:
        """Publish the incomplete batch."""
        if self._batches is not None:
            self._batches.flush()

    def finish(self) -> None:
        """Publish the incomplete batch and wait for its delivery; call it before the node ends."""
        if self._batches is not None:
            self._batches.flush()
            self._batches.delivered()


class BatchQueue:
    """Receives a stream from its batches, or one by one as long as nobody publishes batches.

    Args:
        node: resolves topic names, logs warnings.
        unspun: from :func:`straightcomp_ros.runtime.streams.unspun_node`.
        stream: what to receive.
        depth: messages, or batches, that the middleware keeps.
        complete: ask the publisher for lost batches again (reliable QoS).
    """

    def __init__(self, node: Node, unspun: Node, stream: Stream, depth: int = 1000, complete: bool = False) -> None:
        def queue(kind: type, topic: str, reliable: bool = False) -> RawQueue:
            return RawQueue(unspun, kind, node.resolve_topic_name(topic), stream_qos(depth, reliable))

        kind = message_type(stream.layout.type_name)
        self._make_direct: Callable[[], RawQueue] = lambda: queue(kind, stream.topic)
        self._stream = stream
        self._batches = queue(UInt8MultiArray, stream.batch_topic, complete)
        self._direct: RawQueue | None = self._make_direct()
        self._dropped = Complaints(node, f"batches on '{stream.batch_topic}' are dropped")
        self._newest_ns: int | None = None
        """Stamp of the newest message received one by one; batches repeat the messages up to it."""
        self._looked_ns = 0

    def wait(self, timeout_ns: int) -> None:
        """Return when a message or batch has arrived, or after ``timeout_ns``."""
        (self._direct or self._batches).wait(timeout_ns)

    @property
    def connected(self) -> bool:
        """Whether the middleware has connected a publisher."""
        return self._batches.connected or (self._direct is not None and self._direct.connected)

    def fetch(self) -> Messages:
        """Messages since the last call, without duplicates."""
        if self._direct is None:
            self._look()
        copies = self._unpacked(self._batches.fetch())
        messages: Messages = []
        if self._direct is not None:
            # What is too short for a stamp is no message of the stream.
            messages = [message for message in self._direct.fetch() if len(message[0]) >= SHORTEST]
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
        """The messages of the batches; ``source_timestamp`` is the time at which a message was made."""
        size, messages = self._stream.layout.size, Messages()
        for batch, info in batches:
            received_ns = info["received_timestamp"]
            try:
                messages += [
                    (data, {"received_timestamp": received_ns, "source_timestamp": made_ns})
                    for made_ns, data in unpack_batch(batch, size)
                ]
            except LayoutMismatch as error:
                self._dropped.say(error)
        return messages

    @staticmethod
    def _came_directly(stamp_ns: int, newest_ns: int) -> bool:
        # A batch is some milliseconds late. One that seems later comes from another source with another clock.
        return 0 <= newest_ns - stamp_ns < _LONGEST_DELAY_NS

    def _look(self) -> None:
        """Check five times a second whether the batches still have a publisher."""
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = now_ns
            if not self._batches.connected:
                self._direct = self._make_direct()


def batched_queue(node: Node, unspun: Node, stream: Stream) -> SubscriptionQueue:
    """A queue of a stream's messages that are taken from its batches; arguments as of :class:`BatchQueue`."""
    return SubscriptionQueue(node, unspun, stream, BatchQueue(node, unspun, stream))
