"""Publishers and subscriptions of the contract's streams, as serialised bytes of a fixed layout."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.contract import Stream
from straightcomp_ros.messages.cdr import LayoutMismatch, read_by_names
from straightcomp_ros.runtime.guarded_node import Complaints
from straightcomp_ros.runtime.inside_rclpy import raw_publish, raw_take, waiter

_MESSAGE_TYPES = {"sensor_msgs/msg/JointState": JointState, "trajectory_msgs/msg/JointTrajectory": JointTrajectory}


def message_type(type_name: str) -> Any:
    """The message class of a stream's type."""
    return _MESSAGE_TYPES[type_name]


def stream_qos(depth: int = 1000, reliable: bool = False) -> QoSProfile:
    """Best effort, since a late sample is useless to a servo; reliable for the batches that the recorder reads. The
    depth covers some seconds in which a process is suspended, where a socket's buffer is full after 50 ms."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)


def publisher(node: Node, stream: Stream) -> Callable[..., None]:
    """A function ``publish(stamp_ns, *numbers)`` for one stream."""
    publish, pack = raw_publish(stream_publisher(node, stream)), stream.layout.pack

    def send(stamp_ns: int, *numbers: float) -> None:
        publish(pack(stamp_ns, *numbers))

    return send


def stream_publisher(node: Node, stream: Stream) -> Publisher:
    """rclpy's publisher of a stream."""
    return node.create_publisher(message_type(stream.layout.type_name), stream.topic, stream_qos())


def subscribe(node: Node, stream: Stream, callback: Callable[[int, Sequence[float]], None]) -> None:
    """Call ``callback(stamp_ns, numbers)`` for each message of a stream as it arrives.

    :func:`_reader` describes what happens to a message of another layout.
    """
    read = _reader(node, stream)

    def receive(data: bytes) -> None:
        message = read(data)
        if message:
            callback(*message)

    node.create_subscription(message_type(stream.layout.type_name), stream.topic, receive, stream_qos(), raw=True)


Messages = list[tuple[bytes, Mapping[str, int]]]
"""Serialised messages with the middleware's times ``received_timestamp`` and ``source_timestamp``."""


class Fetched(Protocol):
    """Messages that wait until they are fetched."""

    @property
    def connected(self) -> bool:
        """Whether the middleware has connected a publisher."""

    def fetch(self) -> Messages:
        """Messages since the last call."""

    @property
    def wait(self) -> Callable[[int], None]:
        """``wait(timeout_ns)`` returns when messages have arrived, or after that time."""


class SubscriptionQueue:
    """A stream whose messages wait in the middleware until they are fetched.

    A message does not wake this process. A loop that looks into its queue anyway saves two context switches a message.
    The subscription belongs to an unspun node, which no executor spins.

    Args:
        node: resolves topic names and logs warnings.
        unspun: from :func:`unspun_node`.
        stream: what to receive.
        queue: where the messages wait, if not in a subscription to the stream's own topic.

    Attributes:
        sent_ns: when each message of the last :meth:`fetch` was sent, ns since the epoch.
    """

    def __init__(self, node: Node, unspun: Node, stream: Stream, queue: Fetched | None = None) -> None:
        self._read = _reader(node, stream)
        self._queue = queue or RawQueue(
            unspun, message_type(stream.layout.type_name), node.resolve_topic_name(stream.topic)
        )
        self.sent_ns: list[int] = []

    def wait(self, timeout_ns: int) -> None:
        """Return when a message has arrived, or after ``timeout_ns``."""
        self._queue.wait(timeout_ns)

    def fetch(self) -> list[tuple[int, Sequence[float], int]]:
        """Messages since the last call: (stamp in ns, numbers, reception time in ns since the epoch)."""
        read = self._read
        messages = []
        self.sent_ns = sent_ns = []
        for data, info in self._queue.fetch():
            message = read(data)
            if message:
                messages.append((*message, info["received_timestamp"]))
                sent_ns.append(info["source_timestamp"])
        return messages


class RawQueue:
    """Serialised messages of one topic, fetched by the caller.

    Args:
        unspun: from :func:`unspun_node`.
        kind: message class.
        topic: full name.
        qos: of the subscription; its depth limits the number of waiting messages.

    Attributes:
        wait: ``wait(timeout_ns)`` returns when a message has arrived, or after that time.
    """

    def __init__(self, unspun: Node, kind: Any, topic: str, qos: QoSProfile | None = None) -> None:
        self._unspun = unspun
        self._subscription = unspun.create_subscription(kind, topic, lambda _: None, qos or stream_qos(), raw=True)
        self._take, self.wait = raw_take(self._subscription), waiter(unspun, self._subscription)

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

    def close(self) -> None:
        """End the subscription."""
        self._unspun.destroy_subscription(self._subscription)


def unspun_node(node: Node) -> Node:
    """A node that no executor spins, for subscriptions that are only fetched; `ros2 node list` hides it by its `_`."""
    return Node(
        f"_{node.get_name()}_subscriptions",
        namespace=node.get_namespace(),
        use_global_arguments=False,
        enable_rosout=False,
        start_parameter_services=False,
    )


def _reader(node: Node, stream: Stream) -> Callable[[bytes], tuple[int, Sequence[float]] | None]:
    """A function from a serialised message to (stamp_ns, numbers), or None if it lacks a field of the stream.

    A message of another layout (other names or order, from another vendor's publisher) is deserialised and read by its
    names. One that cannot be read is dropped, with a warning.
    """
    layout = stream.layout
    kind = message_type(layout.type_name)
    unpack, dropped = layout.unpack, Complaints(node, f"messages on '{stream.topic}' are dropped")

    def read(data: bytes) -> tuple[int, Sequence[float]] | None:
        try:
            return unpack(data)
        except LayoutMismatch:
            pass
        try:
            return read_by_names(layout, deserialize_message(data, kind))
        except LayoutMismatch as error:
            dropped.say(f"they lack {error}")
        except Exception as error:  # The middleware raises errors of several kinds on malformed bytes.
            dropped.say(f"they are malformed: {error}")
        return None

    return read
