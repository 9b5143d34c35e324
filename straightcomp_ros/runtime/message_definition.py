"""Message definitions, from their Python classes, of types that ROS 2's own packages do not have.

A bag stores a definition beside the messages. The classes know names and types of all fields, but not the constants,
defaults and comments of the .msg file, which no reader of messages needs.
"""

import importlib
import re
from typing import Any

from straightcomp_ros.bags.topics import Definition, typestore

_RULE = "=" * 80
_PRIMITIVES = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
_SEQUENCE = re.compile(r"sequence<(?P<of>.+?)(?:, (?P<bound>\d+))?>")
_ARRAY = re.compile(r"(?P<of>.+)\[(?P<size>\d+)\]")
_BOUNDED_TEXT = re.compile(r"(?P<of>w?string)<(?P<bound>\d+)>")


def message_class(type_name: str) -> Any:
    """The class of a type such as ``sensor_msgs/msg/Range``; None if its package is not installed."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None


def definition_of_class(kind: Any) -> Definition:
    """Definition of a message class: text in encoding ``ros2msg``, and type hash."""
    from rosbags.typesys import get_types_from_msg, get_typestore
    from rosbags.typesys.stores import Stores

    texts: dict[str, str] = {}
    _collect(kind, texts)
    name = _name(kind)
    first, *others = texts
    parts = [texts[first], *(f"{_RULE}\nMSG: {_short(other)}\n{texts[other]}" for other in others)]
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("\n".join(parts), name))
    return Definition("\n".join(parts), store.hash_rihs01(name))


def known(type_name: str) -> bool:
    """Whether ROS 2's own packages define the type."""
    return type_name in typestore().fielddefs


def _collect(kind: Any, texts: dict[str, str]) -> None:
    if _name(kind) in texts:
        return
    lines: list[str] = []
    texts[_name(kind)] = ""
    for name, text in kind.get_fields_and_field_types().items():
        written, nested = _written(text)
        lines.append(f"{written} {name}")
        if nested:
            _collect(message_class(nested), texts)
    texts[_name(kind)] = "\n".join(lines) + "\n"


def _written(text: str) -> tuple[str, str]:
    """A field's type as in a .msg file, and the message type that it contains, if any."""
    if match := _SEQUENCE.fullmatch(text):
        inner, nested = _written(match["of"])
        return f"{inner}[{'<=' + match['bound'] if match['bound'] else ''}]", nested
    if match := _ARRAY.fullmatch(text):
        inner, nested = _written(match["of"])
        return f"{inner}[{match['size']}]", nested
    if match := _BOUNDED_TEXT.fullmatch(text):
        return f"{match['of']}<={match['bound']}", ""
    if "/" in text:
        return text, text.replace("/", "/msg/", 1)
    return _PRIMITIVES.get(text, text), ""


def _name(kind: Any) -> str:
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def _short(type_name: str) -> str:
    return type_name.replace("/msg/", "/")
