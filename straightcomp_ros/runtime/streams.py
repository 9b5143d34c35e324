"""A node's ends of the contract's streams: publishers and queues of serialised bytes, one by one and in batches.

The controller's samples and the driver's commands must arrive one by one. Subscribers that record, display or look
ahead take batches, the messages of some milliseconds in one, and cost the loop little (docs/design.md). A stream that
no control loop waits for is published one by one only while it has a subscriber.

The loops know a stream only as a function ``publish(stamp_ns, *numbers)`` and as a queue of (stamp, numbers, arrival);
they get both from :class:`Streams`. Between nodes of one process the numbers are handed over in memory.
"""

import importlib
import itertools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import UInt8MultiArray

from straightcomp_ros.contract import Stream
from straightcomp_ros.messages.cdr import (
    SHORTEST,
    LayoutMismatch,
    header_stamp_ns,
    pack_batch,
    read_by_names,
    unpack_batch,
)
from straightcomp_ros.runtime.guarded_node import ThrottledWarning
from straightcomp_ros.runtime.inside_rclpy import publisher_count, raw_publish, raw_take, unlocked_publish, waiter
from straightcomp_ros.runtime.intra_process import IntraProcess, MemoryQueue
from straightcomp_ros.runtime.loops import WorkerThread

BATCH_S, LOOK_AHEAD_S = 0.004, 0.002
"""Length of a batch for subscribers that record or display, and for the feedforward, which looks ahead."""
_LONGEST = 64
"""Messages in the largest batch, after a stall: it fits into one packet of a loopback socket."""
_first_batches = itertools.cycle((0.125, 0.5, 0.875, 0.25, 0.625, 1.0, 0.375, 0.75))
"""Lengths of the first batches of a process's streams, relative to the later ones: its batches must not all be
published in the same cycle."""
_RECORDED_ONLY = 32
"""Messages in a batch that no control loop waits for, since its readers there are in this process: a datagram of 4 kB.
Sending takes most of such a process's time, and long batches a quarter of what short ones do."""
_KEPT, _RECORDS_KEPT = 5000, 1250
"""Batches that a publisher keeps for a recorder that is behind: those of 20 s, of the long ones at 2 kHz. One that was
killed counts as behind until its lease ends, and the middleware does not give the memory back."""
_TURNS_OF_OTHERS = 3
"""Threads that run between sample and command: the middleware's receiver, the controller, our own receiver."""
_FLUSH_S = 0.5
"""Longest time for which an incomplete batch waits for more messages."""
_DELIVERY = Duration(seconds=0.2)
"""Longest wait for subscribers to acknowledge the last batches."""
_LOOK_NS = 200_000_000
_LONGEST_DELAY_NS = 1_000_000_000

Messages = list[tuple[bytes, Mapping[str, int]]]
"""Serialised messages with the middleware's times ``received_timestamp`` and ``source_timestamp``."""


def message_class(type_name: str) -> Any:
    """The class of a type such as ``sensor_msgs/msg/Range``; None if its package is not installed."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None


def stream_qos(depth: int = 1000, reliable: bool = False) -> QoSProfile:
    """Best effort, since a late sample is useless to a servo; reliable for the batches that the recorder reads. The
    depth covers some seconds in which a process is suspended, where a socket's buffer is full after 50 ms."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)


def stream_publisher(node: Node, stream: Stream) -> Publisher:
    """rclpy's publisher of a stream."""
    return node.create_publisher(message_class(stream.layout.type_name), stream.topic, stream_qos())


class StreamPublisher:
    """Publishes a stream in batches, and each message by itself: at once, or with its batch while it has a subscriber.

    A control loop waits for what is published ``at_once``; the batch follows when the caller has time for it. ``rate``
    is in messages per second, ``seconds`` the length of a batch. With ``rate`` None the caller's cycles end the
    batches; at once there are no batches then: in lockstep the next message waits for the answer to the last one, so a
    batch would never fill. ``kept`` batches wait for a recorder. With a ``sender`` that thread sends the messages.
    """

    def __init__(
        self,
        node: Node,
        stream: Stream,
        rate: float | None = None,
        seconds: float = BATCH_S,
        *,
        at_once: bool = False,
        kept: int = _KEPT,
        sender: WorkerThread | None = None,
    ) -> None:
        self._pack, self._sender = stream.layout.pack, sender
        self._publisher = stream_publisher(node, stream)
        self._publish = _sending(self._publisher, sender)
        self._at_once, self._by_cycle = at_once, at_once or rate is None
        self._waiting: list[tuple[int, bytes]] = []
        """Serialised messages with the time each was made."""
        self._length = max(1, round(rate * seconds)) if rate is not None else 1
        self._room = 1 if rate is None else max(1, round(self._length * next(_first_batches)))
        self._batches: Publisher | None = None
        if rate is not None or not at_once:
            self._batches = node.create_publisher(UInt8MultiArray, stream.batch_topic, stream_qos(kept, reliable=True))
            self._publish_batch = _sending(self._batches, sender, pack_batch)
            node.create_timer(_FLUSH_S, self.flush)

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Publish one message, now or in a batch with later ones."""
        data = self._pack(stamp_ns, *numbers)
        if self._at_once:
            self._publish(data)
        if self._batches is not None:
            self._waiting.append((time.time_ns(), data))
            self._room -= 1
            if not self._by_cycle:
                self.publish_batch()

    def publish_batch(self) -> None:
        """Publish the batch if it is complete; at once streams: after the control loop has its message."""
        if self._room <= 0:
            self.flush()

    def flush(self) -> None:
        """Publish the incomplete batch."""
        waiting, self._waiting = self._waiting, []
        if self._room <= 0:
            self._room = self._length
        for first in range(0, len(waiting), _LONGEST):
            self._publish_batch(waiting[first : first + _LONGEST])
        if waiting and not self._at_once and self._publisher.get_subscription_count():
            for _, data in waiting:
                self._publish(data)

    def finish(self) -> None:
        """Publish the incomplete batch and wait for its acknowledgement before the node ends: a subscriber that first
        learns that its publisher has ended drops the messages."""
        self.flush()
        if self._sender:
            self._sender.wait()
        if self._batches is not None:
            self._batches.wait_for_all_acked(_DELIVERY)


class RecordPublisher(StreamPublisher):
    """Publisher of a node whose readers in the loop are in its own process: ``queues`` get the numbers at once, and all
    others batches, which are packed and sent when the command has been written: see :meth:`publish_new`."""

    def __init__(self, node: Node, stream: Stream, queues: Sequence[MemoryQueue], sender: WorkerThread) -> None:
        super().__init__(node, stream, _RECORDED_ONLY, 1.0, kept=_RECORDS_KEPT, sender=sender)
        self._queues = queues
        self._new: list[tuple[int, int, tuple[float, ...]]] = []

    def __call__(self, stamp_ns: int, *numbers: float) -> None:
        """Hand the message over; it waits for the next :meth:`publish_new`."""
        made_ns = time.time_ns()
        for queue in self._queues:
            queue.put(stamp_ns, numbers, made_ns)
        self._new.append((made_ns, stamp_ns, numbers))

    def publish_batch(self) -> None:
        """Do nothing: the command comes first."""

    def publish_new(self) -> None:
        """Pack what is new, and publish the batch if it is complete."""
        new, self._new = self._new, []
        pack = self._pack
        self._waiting += [(made_ns, pack(stamp_ns, *numbers)) for made_ns, stamp_ns, numbers in new]
        self._room -= len(new)
        super().publish_batch()

    def flush(self) -> None:
        """Publish the incomplete batch, with what is new."""
        if self._new:
            self.publish_new()
        super().flush()


class RawQueue:
    """Serialised messages of the topic with this full name, fetched by the caller. The depth of ``qos`` limits the
    number of waiting messages; ``wait(timeout_ns)`` returns when one has arrived, or after that time."""

    def __init__(self, unspun: Node, kind: Any, topic: str, qos: QoSProfile) -> None:
        self._unspun = unspun
        self._subscribe = partial(unspun.create_subscription, kind, topic, lambda _: None, qos, raw=True)
        self._open()

    def _open(self) -> None:
        self._subscription = self._subscribe()
        self._take, self.wait = raw_take(self._subscription), waiter(self._unspun, self._subscription)

    @property
    def connected(self) -> bool:
        """Whether the middleware has connected a publisher."""
        return bool(self._subscription.get_publisher_count())

    def fetch(self) -> Messages:
        """Messages since the last call."""
        take, messages = self._take, []
        while (message := take()) is not None:
            messages.append(message)
        return messages

    def renew(self) -> None:
        """Subscribe anew: the messages that latched publishers keep come again, also those that wait here."""
        self.close()
        self._open()

    def close(self) -> None:
        """End the subscription."""
        self._unspun.destroy_subscription(self._subscription)


class BatchQueue:
    """Receives a stream from its batches, or one by one as long as no node publishes batches.

    ``depth`` is the number of messages, or batches, that the middleware keeps. With ``complete`` it asks the publisher
    for lost batches again (reliable QoS).
    """

    def __init__(self, node: Node, unspun: Node, stream: Stream, depth: int = 1000, complete: bool = False) -> None:
        kind, topic = message_class(stream.layout.type_name), node.resolve_topic_name(stream.topic)
        self._make_direct: Callable[[], RawQueue] = lambda: RawQueue(unspun, kind, topic, stream_qos(depth))
        self._size = stream.layout.size
        batches = node.resolve_topic_name(stream.batch_topic)
        self._batches = RawQueue(unspun, UInt8MultiArray, batches, stream_qos(depth, complete))
        self._direct: RawQueue | None = self._make_direct()
        self._dropped = ThrottledWarning(node, f"batches on '{stream.batch_topic}' are dropped")
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
        repeated = self._unpacked(self._batches.fetch())
        messages: Messages = []
        if self._direct is not None:
            # What is too short for a stamp is no message of the stream.
            messages = [message for message in self._direct.fetch() if len(message[0]) >= SHORTEST]
            if messages:
                self._newest_ns = header_stamp_ns(messages[-1][0])
            if repeated:
                self._direct.close()
                self._direct = None
        if repeated and self._newest_ns is not None:
            newest_ns = self._newest_ns
            # A batch is some milliseconds late. One that seems later comes from another source with another clock.
            repeated = [
                message for message in repeated if not 0 <= newest_ns - header_stamp_ns(message[0]) < _LONGEST_DELAY_NS
            ]
            if repeated:
                self._newest_ns = None
        return messages + repeated

    def _unpacked(self, batches: Messages) -> Messages:
        """The messages of the batches; ``source_timestamp`` is the time at which a message was made."""
        messages: Messages = []
        for batch, info in batches:
            received_ns = info["received_timestamp"]
            try:
                messages += [
                    (data, {"received_timestamp": received_ns, "source_timestamp": made_ns})
                    for made_ns, data in unpack_batch(batch, self._size)
                ]
            except LayoutMismatch as error:
                self._dropped.log(error)
        return messages

    def _look(self) -> None:
        """Check five times a second whether the batches still have a publisher."""
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns >= _LOOK_NS:
            self._looked_ns = now_ns
            if not self._batches.connected:
                self._direct = self._make_direct()


class SubscriptionQueue:
    """A stream whose messages wait in the middleware until they are fetched.

    A message of another layout (other names or order, from another vendor's publisher) is deserialised and read by its
    names. One that cannot be read is dropped, with a warning.

    Attributes:
        wait: ``wait(timeout_ns)`` returns when a message has arrived, or after that time.
        sent_ns: when each message of the last :meth:`fetch` was sent, ns since the epoch.
    """

    def __init__(self, node: Node, stream: Stream, queue: RawQueue | BatchQueue) -> None:
        self._layout, self._queue, self.wait = stream.layout, queue, queue.wait
        self._dropped = ThrottledWarning(node, f"messages on '{stream.topic}' are dropped")
        self.sent_ns: list[int] = []

    def fetch(self) -> list[tuple[int, Sequence[float], int]]:
        """Messages since the last call: (stamp in ns, numbers, reception time in ns since the epoch)."""
        unpack = self._layout.unpack
        messages: list[tuple[int, Sequence[float], int]] = []
        self.sent_ns = sent_ns = []
        for data, info in self._queue.fetch():
            try:
                message: tuple[int, Sequence[float]] | None = unpack(data)
            except LayoutMismatch:
                message = self._read_by_names(data)
            if message:
                messages.append((*message, info["received_timestamp"]))
                sent_ns.append(info["source_timestamp"])
        return messages

    def _read_by_names(self, data: bytes) -> tuple[int, Sequence[float]] | None:
        layout = self._layout
        try:
            return read_by_names(layout, deserialize_message(data, message_class(layout.type_name)))
        except LayoutMismatch as error:
            self._dropped.log(f"they lack {error}")
        except Exception as error:  # The middleware raises errors of several kinds on malformed bytes.
            self._dropped.log(f"they are malformed: {error}")
        return None


class Streams:
    """The ends of streams that one component of ``node`` uses, until :meth:`close`.

    With ``shared`` the streams of this process are handed over in memory; nodes do their cycles in the order in which
    their ends are made.

    Attributes:
        cycle: that of the node, for the driver's loop; nothing until :meth:`follow`.
        records: by topic, publishers whose messages wait for :meth:`publish_records`.
    """

    def __init__(self, node: Any, shared: IntraProcess | None = None) -> None:
        self._node, self._shared = node, shared
        self.cycle: Callable[[], object] = _nothing
        self.records: dict[str, RecordPublisher] = {}
        self._memory: list[MemoryQueue] = []
        self._unspun: Node | None = None
        if shared:
            shared.ends.append(self)

    @property
    def unspun(self) -> Node:
        """A node that no executor spins, for subscriptions that are only fetched; `ros2 node list` hides its name."""
        if self._unspun is None:
            self._unspun = Node(
                f"_{self._node.get_name()}_subscriptions",
                namespace=self._node.get_namespace(),
                use_global_arguments=False,
                enable_rosout=False,
                start_parameter_services=False,
            )
        return self._unspun

    def raw(self, kind: Any, topic: str, qos: QoSProfile | None = None) -> RawQueue:
        """The serialised messages of a topic."""
        return RawQueue(self.unspun, kind, self._node.resolve_topic_name(topic), qos or stream_qos())

    def raw_batches(self, stream: Stream, depth: int = 1000, complete: bool = False) -> BatchQueue:
        """The stream's serialised messages, taken from its batches; see :class:`BatchQueue`."""
        return BatchQueue(self._node, self.unspun, stream, depth, complete)

    def queue(self, stream: Stream) -> SubscriptionQueue | MemoryQueue:
        """The stream's messages, each as it was published."""
        kind = message_class(stream.layout.type_name)
        return self._in_memory(stream) or SubscriptionQueue(self._node, stream, self.raw(kind, stream.topic))

    def batches(self, stream: Stream) -> SubscriptionQueue | MemoryQueue:
        """The stream's messages, taken from its batches."""
        return self._in_memory(stream) or SubscriptionQueue(self._node, stream, self.raw_batches(stream))

    def publisher(
        self, stream: Stream, rate: float | None, seconds: float = BATCH_S, *, at_once: bool = False
    ) -> StreamPublisher:
        """See :class:`StreamPublisher`."""
        sender = self._shared.sender if self._shared else None
        # What is published at once without being handed over is what others wait for.
        if not self._shared or (at_once and stream.topic not in self._shared.queues):
            return StreamPublisher(self._node, stream, rate, seconds, at_once=at_once, sender=sender)
        queues = self._shared.queues.get(stream.topic, ())
        self.records[stream.topic] = RecordPublisher(self._node, stream, queues, self._shared.sender)
        return self.records[stream.topic]

    def follow(self, cycle: Callable[[], object]) -> None:
        """In a process of several nodes: let the driver's loop call ``cycle``, in place of this node's own loop."""
        self.cycle = lambda: cycle() if self._node.active else None

    def let_readers_run(self) -> bool:
        """Let those run who wait for what was published just now; returns whether they have had their turn."""
        if self._shared:
            self._shared.deliver()
            return True
        if os.sched_getscheduler(0) != os.SCHED_FIFO:
            return False
        # At one real-time priority a process that was woken on this CPU runs only when this one yields.
        for _ in range(_TURNS_OF_OTHERS):
            os.sched_yield()
        return True

    def publish_records(self) -> None:
        """In a process of several nodes: pack and publish what is only watched and recorded, after the command."""
        if self._shared:
            self._shared.publish_records()

    def look_for_others(self, stream: Stream) -> Callable[[], bool]:
        """A function that says whether another process publishes a stream that is handed over in memory: its messages
        are not taken. The thread that sends looks, since that takes longer than a period at 8 kHz, and each call says
        what the look that the last one asked for has found."""
        if not self._shared:
            return lambda: False
        shared, found = self._shared, [False]
        count = publisher_count(self._node, self._node.resolve_topic_name(stream.topic))

        def look() -> None:
            # One is our own, which lives on for a moment after its node has released it.
            found[0] = count() > 1

        def others() -> bool:
            shared.sender.run(look)
            return found[0]

        return others

    def sending(self, publisher: Publisher) -> Callable[[bytes], None]:
        """A function that sends a serialised message: in a process of several nodes by the thread that sends."""
        return _sending(publisher, self._shared.sender if self._shared else None)

    def _in_memory(self, stream: Stream) -> MemoryQueue | None:
        if not self._shared or stream.topic not in self._shared.queues:
            return None
        queue = MemoryQueue(self._shared)
        self._shared.queues[stream.topic].append(queue)
        self._memory.append(queue)
        return queue

    def close(self) -> None:
        """End the subscriptions and the cycle; all that was published has been sent."""
        self.cycle = _nothing
        if self._shared:
            self.records = {}
            for waiting in self._shared.queues.values():
                waiting[:] = [queue for queue in waiting if queue not in self._memory]
            self._memory = []
            self._shared.sender.wait()
        if self._unspun is not None:
            self._unspun.destroy_node()
            self._unspun = None


def _nothing() -> None:
    pass


def _sending(
    publisher: Publisher, sender: WorkerThread | None, pack: Callable[[Any], bytes] | None = None
) -> Callable[[Any], None]:
    """A function that sends a serialised message, or what ``pack`` makes one of: at once, or in ``sender``'s thread."""
    publish = unlocked_publish(publisher) if sender else raw_publish(publisher)
    send = (lambda content: publish(pack(content))) if pack else publish
    return (lambda content: sender.run(lambda: send(content))) if sender else send
