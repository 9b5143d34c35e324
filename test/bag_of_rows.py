"""Bags of made-up messages."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from straightcomp_ros.bags import PARAMETERS_ATTACHMENT
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import Stream

STORE = get_typestore(Stores.ROS2_JAZZY)
"""The messages of ROS 2 by rosbags, which is not ours."""
Message = tuple[str, str, bytes, int, int]
"""Topic, type, bytes, and the times of reception and of sending in ns."""
Row = tuple[Stream, int, Sequence[float]]
"""A stream, its stamp in ns and its numbers."""
REPORT = "diagnostic_msgs/msg/DiagnosticArray"


def bag_of(path: Path, messages: Iterable[Message], parameters: str = "", **options: Any) -> Path:
    """A bag of these messages; with the nodes' parameters in YAML or not; ``options`` of the writer."""
    with BagWriter(path, **options) as bag:
        if parameters:
            bag.attach(PARAMETERS_ATTACHMENT, "application/yaml", parameters.encode())
        for topic, kind, *message in messages:
            if topic not in bag.topics:
                bag.add(Topic(topic, kind))
            bag.write(topic, *message)
    return path


def packed(rows: Iterable[Row]) -> Iterator[Message]:
    """The rows as messages that are sent and received at their stamps."""
    for stream, stamp, numbers in rows:
        yield f"/{stream.topic}", stream.layout.type_name, stream.layout.pack(stamp, *numbers), stamp, stamp


def bag_of_rows(path: Path, rows: Iterable[Row], parameters: str = "") -> Path:
    """A bag of these rows, as :func:`bag_of` makes it."""
    return bag_of(path, packed(rows), parameters)


def header(stamp: int, frame: str = "") -> Any:
    return STORE.types["std_msgs/msg/Header"](STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), frame)


def report(node: str, stamp: int, **values: str) -> bytes:
    """The diagnostics of a node with these values, as CDR."""
    pairs = [STORE.types["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in values.items()]
    status = STORE.types["diagnostic_msgs/msg/DiagnosticStatus"](0, node, "running", "", pairs)
    return bytes(STORE.serialize_cdr(STORE.types[REPORT](header(stamp), [status]), REPORT))


def messages_of(bag: Path) -> list[Message]:
    """All messages of a finished bag by time, as rosbags reads them, which knows no time of sending."""
    with Reader(bag) as reader:
        return [(one.topic, one.msgtype, bytes(data), time_ns, time_ns) for one, time_ns, data in reader.messages()]


def by_rosbags(path: Path, messages: Iterable[Message]) -> Path:
    """A bag of SQLite with these messages, as rosbags writes it."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, data, time_ns, _ in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time_ns, data)
    return path
