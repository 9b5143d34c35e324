"""What a message type is: its definition text and its type hash, as rosbag2 stores them beside the messages."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from straightcomp_ros.bags import BagError

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


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy."""
    # Takes half a second, and a bag with our own layouts is read without it.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


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
