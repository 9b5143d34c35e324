"""Publishers and subscriptions of the contract's streams, as serialised bytes of a fixed layout."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from straightcomp_ros.cdr import LayoutMismatch, read_by_names
from straightcomp_ros.contract import Stream

_MESSAGE_TYPES = {"sensor_msgs/msg/JointState": JointState, "trajectory_msgs/msg/JointTrajectory": JointTrajectory}


def message_type(type_name: str) -> Any:
    """The message class of a stream's type."""
    return _MESSAGE_TYPES[type_name]


def stream_qos(depth: int = 64) -> QoSProfile:
    """Best effort, keep last: a late sample is worth nothing to a servo; loss is counted by the stamps."""
    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)


def publisher(node: Node, stream: Stream) -> Callable[..., None]:
    """A function ``publish(stamp_ns, *numbers)`` for one stream."""
    layout = stream.layout
    publish = node.create_publisher(message_type(layout.type_name), stream.topic, stream_qos()).publish

    def send(stamp_ns: int, *numbers: float) -> None:
        publish(layout.pack(stamp_ns, *numbers))

    return send


def subscribe(node: Node, stream: Stream, callback: Callable[[int, list[float]], None]) -> None:
    """Call ``callback(stamp_ns, numbers)`` for each message of a stream.

    A message of another layout (other names or order, from somebody else's publisher) is deserialised and
    read by its names; one that lacks what the stream promises is dropped, with one warning.
    """
    layout = stream.layout
    kind = message_type(layout.type_name)
    warned = False

    def receive(data: bytes) -> None:
        nonlocal warned
        try:
            stamp_ns, numbers = layout.unpack(data)
        except LayoutMismatch:
            try:
                stamp_ns, numbers = read_by_names(layout, deserialize_message(data, kind))
            except LayoutMismatch as error:
                if not warned:
                    node.get_logger().warning(f"messages on '{stream.topic}' are dropped: they lack {error}")
                    warned = True
                return
        callback(stamp_ns, numbers)

    node.create_subscription(kind, stream.topic, receive, stream_qos(), raw=True)
