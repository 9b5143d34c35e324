"""One number of every message of a topic, whatever its type: ``position[stage_x]``, ``point.y``, ``range``."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import Messages, decoded, read_messages, read_streams, set_back
from straightcomp_ros.bags.topics import Definition, new_typestore, typestore
from straightcomp_ros.contract import DISPLACEMENT, STREAMS
from straightcomp_ros.messages.cdr import NANOSECONDS, Layout, LayoutMismatch

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_IDL_HEAD = re.compile(r"={80}\nIDL: .*\n")
"""Line between the types of a definition in encoding ``ros2idl``."""
_LATEST_NS = (1 << 63) - 1
_LONGEST_GAP_NS = 100_000_000
"""Time between two samples up to which their values are interpolated."""
_STEP = re.compile(r"([A-Za-z_]\w*)(?:\[([^\]]+)\])?")


@dataclass(frozen=True)
class Field:
    """A number in the messages of a topic, which has a relative or full name.

    The path is names separated by dots; ``name[3]`` takes an element of an array, ``name[joint]`` the one that the
    message's ``name`` or ``joint_names`` lists at that place.
    """

    topic: str
    path: str

    @classmethod
    def parsed(cls, text: str, path: str) -> Field:
        """``TOPIC`` or ``TOPIC:PATH``; ``path`` where the text names none. Raises ValueError for any other form."""
        topic, _, given = text.partition(":")
        found = cls(topic, given or path)
        if not topic or not all(_STEP.fullmatch(step) for step in found.path.split(".")):
            raise ValueError(f"{text!r}; allowed: TOPIC or TOPIC:FIELD, FIELD such as point.y or position[stage_x]")
        return found

    def __str__(self) -> str:
        return f"{self.topic}:{self.path}"


@dataclass(frozen=True)
class FieldValues:
    """Stamps (n,) int64 in ns since the epoch, rising, and values (n,) float64 in the unit of the messages.

    ``stamped``: whether the stamps are those of the messages' headers; without headers they are the times of sending.
    """

    stamp: NDArray[np.int64]
    values: NDArray[np.float64]
    stamped: bool

    def at(self, stamps: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Values at ``stamps``, and where they are known: at a sample, or between two that are not far apart."""
        first, last = self.stamp[0], self.stamp[-1]
        place = np.searchsorted(self.stamp[:-1], stamps)
        near = np.diff(self.stamp, prepend=first)[place] <= _LONGEST_GAP_NS
        usable = (self.stamp[place] == stamps) | (near & (stamps > first) & (stamps < last))
        return np.interp((stamps - first) * 1e-9, (self.stamp - first) * 1e-9, self.values), usable


def read_field(bag: Path, field: Field) -> FieldValues:
    """The values of a field in the order of the stamps, the first of each. Raises BagError when the bag cannot be read,
    lacks the topic, or its messages lack the field. Warns (UserWarning) where the stamps go back."""
    messages = read_messages(bag, field.topic)
    known = _layout_with(field, messages)
    if known:
        layout, column = known
        stream = read_streams(bag, {messages.topic: layout})[messages.topic]
        stamp, values, stamped = stream.stamp, stream.columns[column], True
    else:
        stamp, values, stamped = _decoded_values(bag, field, messages)
    if back := set_back(stamp):
        text = f"the stamps on '{messages.topic}' go back by {back:.3g} s and are put in order"
        remedy = "if the clock was set back, readings of two places are mixed: record again"
        warnings.warn(f"bag {bag}: {text}; {remedy}", stacklevel=2)
    stamp, first = np.unique(stamp, return_index=True)
    return FieldValues(stamp, values[first], stamped)


def _decoded_values(bag: Path, field: Field, messages: Messages) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
    """Stamps and values in the order of recording, and whether the stamps are those of headers."""
    types = _types_of(bag, messages)
    stamp, values = np.empty(len(messages.data), np.int64), np.empty(len(messages.data))
    stamped = True
    for place, (data, time_ns) in enumerate(zip(messages.data, messages.publish_time, strict=True)):
        where = f"bag {bag}: topic '{messages.topic}', message {place}"
        message = decoded(where, data, messages.type_name, types)
        values[place] = _value(where, message, field.path)
        stamped = hasattr(getattr(message, "header", None), "stamp")
        if stamped:
            time_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        if abs(time_ns) > _LATEST_NS:
            raise BagError(f"{where} is of {time_ns} ns since the epoch; allowed: <= {_LATEST_NS}")
        stamp[place] = time_ns
    return stamp, values, stamped


def _layout_with(field: Field, messages: Messages) -> tuple[Layout, str] | None:
    """One of our layouts that the first message has, and the column that holds the field: the fast way."""
    for layout in (stream.layout for stream in (*STREAMS, DISPLACEMENT)):
        paths = (f"{array}[{joint}]" for array, joint in layout.places)
        columns = dict(zip(paths, layout.columns, strict=True))
        if layout.type_name == messages.type_name and field.path in columns:
            try:
                layout.unpack(messages.data[0])
            except LayoutMismatch:
                continue
            return layout, columns[field.path]
    return None


def _types_of(bag: Path, messages: Messages) -> Typestore:
    """ROS 2's own types, but that of these messages as the bag describes it: other versions of it have other fields."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    name, known = messages.type_name, typestore()
    where = f"bag {bag}: topic '{messages.topic}' has messages of type '{name}', which the bag does not describe"
    text, _, encoding = messages.described or Definition("", "")
    text = text if isinstance(text, str) else text.decode(errors="replace")
    if not text.strip():
        if name in known.fielddefs:
            return known
        raise BagError(f"{where}; record again where the package of that type is installed")
    try:
        if encoding == "ros2idl":
            parts = map(get_types_from_idl, filter(None, _IDL_HEAD.split(text)))
            described = {key: value for part in parts for key, value in part.items()}
        else:
            described = get_types_from_msg(text, name)
        store = new_typestore()
        for one in described:
            store.fielddefs.pop(one, None)
        store.register(described)
        store.hash_rihs01(name)  # needs the types of all its fields
    except Exception as error:  # The parser raises errors of many kinds on a malformed text.
        if name in known.fielddefs:
            return known
        raise BagError(f"{where}: its text cannot be used ({error})") from error
    return store


def _value(where: str, message: Any, path: str) -> float:
    found = message
    for name, key in (match.groups() for match in map(_STEP.fullmatch, path.split(".")) if match):
        owner, found = found, getattr(found, name, None)
        if found is None:
            # Numbers, texts and arrays have none.
            names = ", ".join(entry for entry in getattr(owner, "__dict__", ()) if not entry.startswith("_"))
            raise BagError(f"{where} has no field '{name}' in '{path}'; it has {names or 'no fields'}")
        if key is not None:
            joints = list(getattr(owner, "name", None) or getattr(owner, "joint_names", None) or [])
            place = int(key) if key.isdecimal() else joints.index(key) if key in joints else None
            if place is None or not hasattr(found, "__len__") or place >= len(found):
                listed = f"; its names are {', '.join(map(str, joints))}" if joints else ""
                raise BagError(f"{where} has no element '{key}' for '{path}'{listed}")
            found = found[place]
    if not isinstance(found, int | float | np.number):
        raise BagError(f"{where}: '{path}' is no number but {type(found).__name__}; name a number in it")
    return float(found)
