"""The serialised messages of one topic of a bag, of whatever type."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Channel, Schema

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.blocks import blocks
from straightcomp_ros.bags.places import FRAME_SIZE, MESSAGE, rows
from straightcomp_ros.bags.reader import opened
from straightcomp_ros.bags.sqlite_input import sqlite_blocks, sqlite_files, sqlite_topics
from straightcomp_ros.bags.topics import resolved


@dataclass
class Messages:
    """Messages of one topic in the order in which they were recorded.

    Attributes:
        topic: its full name.
        type_name: such as ``sensor_msgs/msg/Range``.
        definition: text of the type as the bag has it (schema encoding ``ros2msg``); empty where it has none.
        log_time, publish_time: when each was received, and made by its source, ns since the epoch.
        data: each as CDR.
    """

    topic: str
    type_name: str
    definition: str = ""
    log_time: list[int] = field(default_factory=list)
    publish_time: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)

    def add(self, block: bytes, places: object) -> None:
        """Add the MCAP message records at ``places`` of ``block``."""
        heads = rows(block, places, MESSAGE)  # type: ignore[arg-type]
        self.log_time += heads["log_time"].tolist()
        self.publish_time += heads["publish_time"].tolist()
        for start, length in zip(places.tolist(), heads["length"].tolist(), strict=True):  # type: ignore[attr-defined]
            self.data.append(block[start + MESSAGE.itemsize : start + FRAME_SIZE + length])


def read_messages(bag: Path, topic: str) -> Messages:
    """All messages of ``topic``, named as :func:`straightcomp_ros.bags.topics.resolved` takes it.

    Raises:
        BagError: the bag cannot be read, is damaged, lacks the topic, or has no messages on it.

    Warns:
        UserWarning: the bag was not finished.
    """
    found = _sqlite_messages(bag, topic) if sqlite_files(bag) else _mcap_messages(bag, topic)
    if not found.data:
        raise BagError(f"bag {bag}: topic '{found.topic}' has no messages; was its publisher running?")
    return found


def _mcap_messages(bag: Path, topic: str) -> Messages:
    with opened(bag) as files:
        described = [file.topics() for file in files]
        names = {channel.topic for channels, _ in described for channel in channels.values()}
        full = _named(bag, topic, names)
        found: Messages | None = None
        for file, (channels, schemas) in zip(files, described, strict=True):
            ours = {number: channel for number, channel in channels.items() if channel.topic == full}
            if ours and found is None:
                found = _described(full, next(iter(ours.values())), schemas)
            for block in blocks(file) if ours else ():
                for number, places in block.places.items():
                    if number in ours and found is not None:
                        found.add(block.data, places)
    assert found is not None  # the name was chosen from the channels
    return found


def _sqlite_messages(bag: Path, topic: str) -> Messages:
    files = [(path, sqlite_topics(path)) for path in sqlite_files(bag)]
    full = _named(bag, topic, {entry.name for _, topics in files for entry in topics.values()})
    kinds = {entry.type_name for _, topics in files for entry in topics.values() if entry.name == full}
    found = Messages(full, kinds.pop())
    for path, topics in files:
        for number, entry in topics.items():
            for block, places in sqlite_blocks(path, number) if entry.name == full else ():
                found.add(block, places)
    return found


def _named(bag: Path, topic: str, names: set[str]) -> str:
    full = resolved(topic, names, str(bag))
    if full is None:
        raise BagError(f"bag {bag}: has no topic '{topic}'; it has {', '.join(sorted(names))}")
    return full


def _described(full: str, channel: Channel, schemas: dict[int, Schema]) -> Messages:
    schema = schemas.get(channel.schema_id)
    if schema is None:
        return Messages(full, "")
    text = schema.data.decode(errors="replace") if schema.encoding == "ros2msg" else ""
    return Messages(full, schema.name, text)
