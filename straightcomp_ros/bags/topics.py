"""The topics of a bag: which one a relative name means, what its messages are, and its quality of service."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import yaml

from straightcomp_ros.bags import BagError
from straightcomp_ros.contract import ENCODER, STREAMS
from straightcomp_ros.parameters.yaml_text import load_yaml

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


ROS_DISTRO = "jazzy"
"""The ROS 2 release whose message definitions are used."""


class Definition(NamedTuple):
    """Definition of one message type.

    ``text`` is the schema in encoding ``ros2msg``: the type's .msg text, then for each type that it needs a line of 80
    ``=``, a line ``MSG: package/Name`` and that type's text; without the comments that rosbag2 keeps and no reader
    needs. ``type_hash`` is the RIHS01 hash (REP 2016), ``RIHS01_`` and 64 hexadecimal digits. Of another bag both may
    be empty, and ``encoding`` and ``text`` of any kind.
    """

    text: str | bytes
    type_hash: str
    encoding: str = "ros2msg"


def new_typestore() -> Typestore:
    """The message types of ROS 2 Jazzy in a store to which others may be added."""
    # Takes half a second, and a bag with our own layouts is read without it.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


typestore = cache(new_typestore)
"""The same, to which nothing is added."""


@cache
def definition(type_name: str) -> Definition:
    """Definition of a type such as ``sensor_msgs/msg/JointState``; BagError when ROS 2 Jazzy's own packages lack it."""
    store = typestore()
    if type_name not in store.fielddefs:
        raise BagError(
            f"message type '{type_name}' is unknown: allowed are the message types of ROS {ROS_DISTRO}, "
            "written as 'sensor_msgs/msg/JointState'"
        )
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return Definition(text, store.hash_rihs01(type_name))


_POLICIES = {
    "history": ("keep_last", "keep_all", "unknown", "system_default"),
    "reliability": ("reliable", "best_effort", "unknown", "best_available", "system_default"),
    "durability": ("transient_local", "volatile", "unknown", "best_available", "system_default"),
}
"""The names in rmw/qos_string_conversions.c, which metadata version 9 stores. Older metadata stores the numbers in
rmw/types.h: 1 is the first name, 0 the last."""
_INFINITE = {"sec": 9223372036, "nsec": 854775807}
"""RMW_DURATION_INFINITE: 2⁶³ − 1 ns."""


@dataclass(frozen=True)
class TopicQos:
    """Quality of service of one topic; deadline, lifespan and lease are infinite, liveliness is automatic.

    ``depth`` messages are kept with ``keep_last``.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10

    def __post_init__(self) -> None:
        for field, allowed in _POLICIES.items():
            if getattr(self, field) not in allowed:
                raise BagError(f"QoS {field} is '{getattr(self, field)}': allowed are {', '.join(allowed)}")
        if self.depth < 0:
            raise BagError(f"QoS depth is {self.depth}: allowed is 0 or more")

    @classmethod
    def from_yaml(cls, text: str) -> TopicQos:
        """The first profile of a list as rosbag2 stores it, with names or (before Jazzy) numbers. What it lacks has its
        default; a text that is no such list gives the default of all."""
        try:
            profile = (load_yaml(text) or [{}])[0]
            found = {name: profile[name] for name in _POLICIES if name in profile}
            named = {k: _POLICIES[k][v - 1] if isinstance(v, int) else str(v) for k, v in found.items()}
            return cls(**named, depth=int(profile.get("depth", cls.depth)))
        except (BagError, AttributeError, LookupError, TypeError, ValueError):
            return cls()

    def as_profiles(self) -> list[dict[str, object]]:
        """The list of one profile that stands in metadata.yaml as ``offered_qos_profiles``."""
        policies = {name: getattr(self, name) for name in ("history", "depth", "reliability", "durability")}
        times = {"deadline": dict(_INFINITE), "lifespan": dict(_INFINITE), "liveliness": "automatic"}
        lease = {"liveliness_lease_duration": dict(_INFINITE), "avoid_ros_namespace_conventions": False}
        return [{**policies, **times, **lease}]

    @cache  # noqa: B019 - a handful of values, as long as the process
    def as_yaml(self) -> str:
        """The same list as text, as it stands in the MCAP channel's metadata."""
        return str(yaml.safe_dump(self.as_profiles(), sort_keys=False)).rstrip()


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: full name, ROS type, quality of service, definition of the type as the bag or its publisher has
    it (None: that of ROS 2's own packages), and encoding of the messages."""

    name: str
    type_name: str
    qos: TopicQos = TopicQos()
    described: Definition | None = None
    encoding: str = "cdr"

    @property
    def full_type(self) -> str:
        """The type with its namespace, which some tools leave out (sensor_msgs/JointState), and which types of ROS 1,
        whose messages are not in CDR, do not have."""
        package, _, name = self.type_name.partition("/")
        short = self.encoding == "cdr" and name and "/" not in name
        return f"{package}/msg/{name}" if short else self.type_name

    @property
    def definition(self) -> Definition:
        """The definition; BagError when neither the topic nor ROS 2's own packages have it."""
        return self.described or definition(self.type_name)


def resolved(name: str, topics: Collection[str], bag: str) -> str | None:
    """The bag's topic for a relative name (``encoder``): ``/encoder``, otherwise the only one of that name in a
    namespace. A full name (``/encoder``) means exactly that topic. Some writers leave out a name's first slash.

    Returns the topic's name in the bag, or None when it is not among ``topics``. Raises BagError, with the name of the
    ``bag``, when several namespaces have the topic.
    """
    absolute = name if name.startswith("/") else f"/{name}"
    found = sorted(topic for topic in topics if topic.endswith(absolute) and absolute != name)
    for exact in (absolute, absolute[1:]):
        if exact in topics:
            return exact
    if len(found) > 1:
        raise BagError(f"bag {bag}: topic '{name}' is {' and '.join(found)}; ask for one by its full name")
    return found[0] if found else None


def topics_of_stage(
    wanted: Iterable[str], topics: Collection[str], bag: str, remap: Mapping[str, str] | None
) -> dict[str, str]:
    """``remap`` with the bag's topic, of ``topics``, for each of the ``wanted`` names of ours that the stage of the
    encoder has; BagError as of :func:`resolved`.

    In the namespace of another stage, with an encoder of its own, nothing is looked for. An encoder alone in its
    namespace, as a filter's, is of no stage in particular.
    """
    found = dict(remap or {})
    encoder = resolved(found.get(ENCODER.topic, ENCODER.topic), topics, bag) or ""
    parts = {name: name.rpartition("/")[::2] for name in topics}
    space, own = encoder.rpartition("/")[::2]
    others = {within for within, last in parts.values() if last == own == ENCODER.topic} - {space}
    if not any((space, one.topic) in parts.values() for one in STREAMS if one is not ENCODER):
        others = set()
    ours = [name for name, (within, _) in parts.items() if within not in others]
    for name in wanted:
        if name not in found and (full := resolved(name, ours, bag)):
            found[name] = full
    return found
