"""Records topics outside the contract: finds them by name when they appear, of any type."""

import re
import time
from collections.abc import Callable, Collection, Iterable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.runtime.message_definition import definition_of_class, known, message_class
from straightcomp_ros.runtime.streams import RawQueue

Add = Callable[[str, bytes, int, int], None]
"""Takes topic, serialised message, reception time and source time in ns since the epoch."""
_LOOK_EVERY_S = 0.5
_UNBOUNDED_DEPTH = 1000
"""Depth for a publisher that keeps all messages, or does not tell how many it keeps."""


class OtherTopics:
    """Subscribes to each matching topic when its first publisher appears, with the QoS that its publishers offer.

    Args:
        node: looks for the topics.
        unspun: from :func:`straightcomp_ros.runtime.streams.unspun_node`.
        pattern: must match a topic's full name; an empty pattern matches none.
        ours: full names that are recorded already.
        announce: called with each topic before its first message is fetched.
    """

    def __init__(
        self,
        node: Node,
        unspun: Node,
        pattern: re.Pattern[str],
        ours: Collection[str],
        announce: Callable[[Topic], None],
    ) -> None:
        self._node, self._unspun, self._pattern, self._announce = node, unspun, pattern, announce
        self._settled = set(ours)
        self._queues: dict[str, RawQueue] = {}
        self._latched: dict[str, tuple[bytes, int]] = {}
        if pattern.pattern:
            node.create_timer(_LOOK_EVERY_S, self._look)
            self._look()

    def fetch(self, add: Add) -> int:
        """Pass on the messages since the last call; returns their number."""
        count = 0
        for name, messages in self._queues.items():
            for data, info in messages.fetch():
                count += 1
                if name in self._latched:
                    self._latched[name] = data, info["source_timestamp"]
                add(name, data, info["received_timestamp"], info["source_timestamp"])
        return count

    def repeat(self, add: Add) -> None:
        """Pass on the last message of each latched topic again, as a new subscriber would get it."""
        for name, (data, source_ns) in self._latched.items():
            if data:
                add(name, data, time.time_ns(), source_ns)

    def _look(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            if name not in self._settled and self._pattern.fullmatch(name):
                publishers = self._node.get_publishers_info_by_topic(name)
                if publishers:
                    self._settled.add(name)
                    self._subscribe(name, sorted(types), publishers)

    def _subscribe(self, name: str, types: list[str], publishers: Iterable[Any]) -> None:
        kind = message_class(types[0])
        if len(types) > 1 or kind is None:
            reason = f"has the types {', '.join(types)}" if len(types) > 1 else f"is of unknown type {types[0]}"
            self._node.get_logger().warning(f"topic '{name}' is not recorded: it {reason}")
            return
        profiles = [publisher.qos_profile for publisher in publishers]
        qos = offered(profiles)
        described = None if known(types[0]) else definition_of_class(kind)
        self._announce(Topic(name, types[0], stored(profiles), described))
        self._queues[name] = RawQueue(self._unspun, kind, name, qos)
        if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            self._latched[name] = b"", 0
        self._node.get_logger().info(f"recording '{name}' ({types[0]}) too")


def offered(profiles: Iterable[QoSProfile]) -> QoSProfile:
    """The strongest QoS that all of these publishers offer."""
    profiles = list(profiles)
    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles)
    latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles)
    depths = [
        profile.depth if profile.history == HistoryPolicy.KEEP_LAST and profile.depth else _UNBOUNDED_DEPTH
        for profile in profiles
    ]
    return QoSProfile(
        depth=max(depths),
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def stored(profiles: Iterable[QoSProfile]) -> TopicQos:
    """The same QoS for a bag. Few middlewares tell a publisher's depth; otherwise it is stored as unknown, with depth
    0, as rosbag2 does, and `ros2 bag play` chooses the depth."""
    profiles = list(profiles)
    told = all(profile.history == HistoryPolicy.KEEP_LAST and profile.depth for profile in profiles)
    qos = offered(profiles)
    return TopicQos(
        reliability=qos.reliability.name.lower(),
        durability=qos.durability.name.lower(),
        history="keep_last" if told else "unknown",
        depth=qos.depth if told else 0,
    )
