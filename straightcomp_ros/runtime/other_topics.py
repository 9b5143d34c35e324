"""Records topics outside the contract: finds them by name when they appear, of any type."""

import re
import time
from collections.abc import Callable, Collection
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from straightcomp_ros.bags.topics import Definition, Topic, TopicQos, typestore
from straightcomp_ros.runtime.streams import RawQueue, Streams, message_class

Add = Callable[[str, bytes, int, int], None]
"""Takes topic, serialised message, reception time and source time in ns since the epoch."""
_LOOK_EVERY_S = 0.5
_UNBOUNDED_DEPTH = 1000
"""Depth for a publisher that keeps all messages, or does not report how many it keeps."""
_RULE = "=" * 80
_PRIMITIVES = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
_SEQUENCE = re.compile(r"sequence<(?P<of>.+?)(?:, (?P<bound>\d+))?>")
_ARRAY = re.compile(r"(?P<of>.+)\[(?P<size>\d+)\]")
_BOUNDED_TEXT = re.compile(r"(?P<of>w?string)<(?P<bound>\d+)>")


class OtherTopics:
    """Subscribes to each topic whose full name matches ``pattern`` (an empty one matches none) and is not one of
    ``ours``, when its first publisher appears, with the QoS that its publishers offer. ``announce`` is called with each
    topic before its first message is fetched."""

    def __init__(
        self,
        node: Node,
        streams: Streams,
        pattern: re.Pattern[str],
        ours: Collection[str],
        announce: Callable[[Topic], None],
    ) -> None:
        self._node, self._streams, self._pattern, self._announce = node, streams, pattern, announce
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
                    self._subscribe(name, sorted(types), [publisher.qos_profile for publisher in publishers])

    def _subscribe(self, name: str, types: list[str], profiles: list[QoSProfile]) -> None:
        kind = message_class(types[0])
        if len(types) > 1 or kind is None:
            reason = f"has the types {', '.join(types)}" if len(types) > 1 else f"is of unknown type {types[0]}"
            self._node.get_logger().warning(f"topic '{name}' is not recorded: it {reason}")
            return
        qos = offered(profiles)
        described = None if types[0] in typestore().fielddefs else definition_of_class(kind)
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


def definition_of_class(kind: Any) -> Definition:
    """Definition of a message class: text in encoding ``ros2msg``, and type hash.

    A bag stores a definition with the messages, also of a type that ROS 2's own packages do not have. The class knows
    names and types of all fields, but not the constants, defaults and comments of the .msg file, which no reader of
    messages needs.
    """
    from rosbags.typesys import get_types_from_msg, get_typestore
    from rosbags.typesys.stores import Stores

    texts: dict[str, str] = {}
    _collect(kind, texts)
    name = _name(kind)
    others = (f"{_RULE}\nMSG: {one.replace('/msg/', '/')}\n{text}" for one, text in texts.items() if one != name)
    text = "\n".join([texts[name], *others])
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    return Definition(text, store.hash_rihs01(name))


def _collect(kind: Any, texts: dict[str, str]) -> None:
    """Add the text of a message class, and of those that it contains, to ``texts``."""
    if _name(kind) in texts:
        return
    lines: list[str] = []
    texts[_name(kind)] = ""
    for name, described in kind.get_fields_and_field_types().items():
        text, nested = _field_type(described)
        lines.append(f"{text} {name}")
        if nested:
            _collect(message_class(nested), texts)
    texts[_name(kind)] = "\n".join(lines) + "\n"


def _field_type(text: str) -> tuple[str, str]:
    """A field's type as in a .msg file, and the message type that it contains, if any."""
    if match := _SEQUENCE.fullmatch(text):
        inner, nested = _field_type(match["of"])
        return f"{inner}[{'<=' + match['bound'] if match['bound'] else ''}]", nested
    if match := _ARRAY.fullmatch(text):
        inner, nested = _field_type(match["of"])
        return f"{inner}[{match['size']}]", nested
    if match := _BOUNDED_TEXT.fullmatch(text):
        return f"{match['of']}<={match['bound']}", ""
    if "/" in text:
        return text, text.replace("/", "/msg/", 1)
    return _PRIMITIVES.get(text, text), ""


def _name(kind: Any) -> str:
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
