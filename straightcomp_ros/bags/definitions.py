"""What a message type is: its definition text and its type hash, as rosbag2 stores them beside the messages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from straightcomp_ros.bags import BagError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ROS_DISTRO = "jazzy"
"""The ROS 2 release whose message definitions are used."""


@dataclass(frozen=True)
class Definition:
    """Definition of one message type.

    Attributes:
        text: schema in encoding ``ros2msg``: the type's .msg text, then for each type it needs a line of 80
            ``=``, a line ``MSG: package/Name`` and that type's text. rosbag2 keeps the comments of the .msg
            files, this text has none; no reader looks at them.
        type_hash: RIHS01 hash (REP 2016), ``RIHS01_`` and 64 hexadecimal digits.
    """

    text: str
    type_hash: str


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy."""
    # Half a second, which a bag of our own layouts never needs.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@cache
def definition(type_name: str) -> Definition:
    """Definition of a type such as ``sensor_msgs/msg/JointState``.

    Raises:
        BagError: ROS 2 Jazzy's own packages have no such message type.
    """
    store = typestore()
    if type_name not in store.fielddefs:
        raise BagError(
            f"message type '{type_name}' is unknown: allowed are the message types of ROS {ROS_DISTRO}, "
            "written as 'sensor_msgs/msg/JointState'"
        )
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return Definition(text, store.hash_rihs01(type_name))
