"""Records topics that the nodes of this package do not publish: finds them by name when they appear."""

import re
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from ament_index_python import get_package_share_directory
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from straightcomp_ros.bags.topics import Definition, Topic, TopicQos, new_typestore, typestore
from straightcomp_ros.runtime.streams import RawQueue, Streams, message_class

Add = Callable[[str, bytes, int, int], None]
"""Takes topic, serialised message, reception time and source time in ns since the epoch."""
_LOOK_EVERY_S = 0.5
_UNBOUNDED_DEPTH = 1000
"""Depth for a publisher that keeps all messages, or does not report how many it keeps."""


class OtherTopics:
    """Subscribes to each topic whose full name matches ``pattern`` (an empty one matches none) and is not one of
    ``ours``, and to each of ``expected`` (full names) if it has the type that is given there, when its first publisher
    appears, with the QoS that its publishers offer. ``announce`` is called with each topic before its first message is
    fetched."""

    def __init__(
        self,
        node: Node,
        streams: Streams,
        pattern: re.Pattern[str],
        expected: Mapping[str, str],
        ours: Collection[str],
        announce: Callable[[Topic], None],
    ) -> None:
        self._node, self._streams, self._pattern, self._announce = node, streams, pattern, announce
        self._settled, self._expected = set(ours), expected
        self._queues: dict[str, RawQueue] = {}
        self._latched: dict[str, tuple[bytes, int]] = {}
        """Of each latched topic: its last message, and when that was sent."""
        if pattern.pattern or expected:
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
        """Pass on what the latched topics have again, as a new subscriber would get it: with the next calls of
        :meth:`fetch` what their publishers keep, at once the last message where no publisher is there any more."""
        for name, (data, source_ns) in self._latched.items():
            if self._queues[name].connected:
                self._queues[name].renew()
            elif data:
                add(name, data, time.time_ns(), source_ns)

    def _look(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            wanted = self._expected.get(name) in types or self._pattern.fullmatch(name)
            new = wanted and name not in self._settled
            if new and (publishers := self._node.get_publishers_info_by_topic(name)):
                self._settled.add(name)
                self._subscribe(name, sorted(types), [publisher.qos_profile for publisher in publishers])

    def _subscribe(self, name: str, types: list[str], profiles: list[QoSProfile]) -> None:
        kind, reason, described = message_class(types[0]), "", None
        if len(types) > 1:
            reason = f"has the types {', '.join(types)}"
        elif kind is None:
            reason = f"is of unknown type {types[0]}"
        elif types[0] not in typestore().fielddefs:
            try:
                described = definition_by_files(types[0])
            except (LookupError, OSError) as error:
                reason = f"is of type {types[0]}, whose definition is not installed: {error}"
        if reason:
            self._node.get_logger().warning(f"topic '{name}' is not recorded: it {reason}")
            return
        qos = offered(profiles)
        self._announce(Topic(name, types[0], stored(profiles), described))
        self._queues[name] = self._streams.raw(kind, name, qos)
        if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            self._latched[name] = b"", 0
        self._node.get_logger().info(f"recording '{name}' ({types[0]}) too")


def offered(profiles: Collection[QoSProfile]) -> QoSProfile:
    """The strongest QoS that all of these publishers offer."""
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


def stored(profiles: Collection[QoSProfile]) -> TopicQos:
    """The same QoS for a bag. Few middlewares report a publisher's depth; otherwise it is stored as unknown, with depth
    0, as rosbag2 does, and `ros2 bag play` chooses the depth."""
    known = all(profile.history == HistoryPolicy.KEEP_LAST and profile.depth for profile in profiles)
    qos = offered(profiles)
    return TopicQos(
        reliability=qos.reliability.name.lower(),
        durability=qos.durability.name.lower(),
        history="keep_last" if known else "unknown",
        depth=qos.depth if known else 0,
    )


def definition_by_files(type_name: str) -> Definition:
    """Definition of a message type of another package than ROS 2's own, by the .msg files that its package and those
    that it needs have installed: a bag stores it with the messages.

    Raises:
        LookupError, OSError: a package or a file is not installed.
    """
    from rosbags.typesys import get_types_from_msg

    store, found, waiting = new_typestore(), dict[str, Any](), [type_name]
    while waiting:
        name = waiting.pop()
        if name not in store.fielddefs and name not in found:
            package, _, kind = name.partition("/msg/")
            file = Path(get_package_share_directory(package), "msg", f"{kind}.msg")
            found |= get_types_from_msg(file.read_text(encoding="utf-8"), name)
            waiting += re.findall(r"\w+/msg/\w+", str(found[name]))
    store.register(found)
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return Definition(text, store.hash_rihs01(type_name))
