"""Reads a bag: streams as columns, attachments, metadata."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.blocks import blocks
from straightcomp_ros.bags.folder import mcap_files, missing_files
from straightcomp_ros.bags.mcap_input import McapInput, attachment_of
from straightcomp_ros.bags.mcap_summary import UNREADABLE
from straightcomp_ros.bags.sqlite_input import sqlite_blocks, sqlite_files, sqlite_topics
from straightcomp_ros.bags.stream_columns import StreamColumns, StreamDecoder
from straightcomp_ros.bags.topics import chosen_topics
from straightcomp_ros.messages.cdr import Layout

__all__ = ["StreamColumns", "opened", "read_attachments", "read_metadata", "read_streams"]


def read_streams(
    bag: Path, layouts: Mapping[str, Layout], remap: Mapping[str, str] | None = None
) -> dict[str, StreamColumns]:
    """Read streams as columns, fast where the messages have the layout, otherwise by the names in them.

    Args:
        bag: rosbag2 folder, or one MCAP file.
        layouts: by topic, relative (``encoder``: ``/encoder``, or else the only ``/…/encoder``) or full.
        remap: for topics of ``layouts`` that are named otherwise in the bag, their names there.

    Returns:
        By the same topic names; a topic that the bag lacks, or that has no messages, is left out.

    Raises:
        BagError: the bag is absent, empty, damaged, without any message, or its messages are of another kind; a
            relative name fits several topics, or ``remap`` names a topic that the bag lacks.

    Warns:
        UserWarning: the bag was not finished; what is whole is read.
    """
    if sqlite_files(bag):
        return _read_sqlite(bag, layouts, remap or {})
    with opened(bag) as files:
        topics = [file.topics() for file in files]
        names = {channel.topic for channels, _ in topics for channel in channels.values()}
        wanted = chosen_topics(layouts, names, str(bag), remap or {})
        decoders = {full: StreamDecoder(f"bag {bag}: topic '{full}'", layouts[key]) for full, key in wanted.items()}
        count = 0
        for file, (channels, schemas) in zip(files, topics, strict=True):
            for channel in channels.values():
                if channel.topic in wanted:
                    schema = schemas.get(channel.schema_id)
                    kind = (schema.name if schema else "", channel.message_encoding)
                    _check_kind(f"bag {file.path}: topic '{channel.topic}'", kind, layouts[wanted[channel.topic]])
            for block in blocks(file):
                for channel_id, places in block.places.items():
                    count += len(places)
                    if channel_id not in channels:
                        raise file.damaged(0, f"it has messages of a channel {channel_id} that it does not describe")
                    decoder = decoders.get(channels[channel_id].topic)
                    if decoder:
                        decoder.add(block.data, places)
        if not count:
            raise BagError(f"bag {bag} has no messages; record again, and check that the topics are published")
    finished = ((key, decoders[full].finished()) for full, key in wanted.items())
    return {key: columns for key, columns in finished if columns is not None}


def _read_sqlite(bag: Path, layouts: Mapping[str, Layout], remap: Mapping[str, str]) -> dict[str, StreamColumns]:
    files = [(path, sqlite_topics(path)) for path in sqlite_files(bag)]
    names = {topic.name for _, topics in files for topic in topics.values()}
    wanted = chosen_topics(layouts, names, str(bag), remap)
    decoders = {full: StreamDecoder(f"bag {bag}: topic '{full}'", layouts[key]) for full, key in wanted.items()}
    for path, topics in files:
        for topic_id, topic in topics.items():
            if topic.name in wanted:
                kind = (topic.type_name, topic.encoding)
                _check_kind(f"bag {path}: topic '{topic.name}'", kind, layouts[wanted[topic.name]])
                for data, places in sqlite_blocks(path, topic_id):
                    decoders[topic.name].add(data, places)
    finished = {key: decoders[full].finished() for full, key in wanted.items()}
    if not any(columns is not None for columns in finished.values()):
        raise BagError(f"bag {bag} has no messages on {', '.join(layouts)}; its topics are {', '.join(sorted(names))}")
    return {key: columns for key, columns in finished.items() if columns is not None}


def read_attachments(bag: Path) -> dict[str, bytes]:
    """The files attached to a bag, by name; of two with one name the later.

    Raises:
        BagError: the bag is absent or damaged.
    """
    found: dict[str, bytes] = {}
    if sqlite_files(bag):
        return found  # SQLite bags have none
    with opened(bag) as files:
        for file in files:
            for record in file.records(Opcode.ATTACHMENT):
                attachment = attachment_of(file, record)
                found[attachment.name] = attachment.data
    return found


def read_metadata(bag: Path) -> dict[str, dict[str, str]]:
    """The texts of a bag's metadata records, by name of the record and key.

    Raises:
        BagError: the bag is absent or damaged.
    """
    found: dict[str, dict[str, str]] = {}
    with opened(bag) as files:
        for file in files:
            # Metadata records have no checksum of their own.
            file.check_data_section()
            for record in file.records(Opcode.METADATA):
                try:
                    metadata = Metadata.read(ReadDataStream(BytesIO(record.content)))
                except UNREADABLE as error:
                    raise file.damaged(record.offset, f"metadata cannot be read ({error})") from error
                found.setdefault(metadata.name, {}).update(metadata.metadata)
    return found


def _check_kind(topic: str, kind: tuple[str, str], layout: Layout) -> None:
    type_name, encoding = kind
    # Some tools write the type without its namespace: sensor_msgs/JointState.
    if layout.type_name not in (type_name, type_name.replace("/", "/msg/", 1)) or encoding != "cdr":
        raise BagError(
            f"{topic} has messages of type '{type_name}' in encoding '{encoding}'; "
            f"allowed is {layout.type_name} in encoding 'cdr'"
        )


@contextmanager
def opened(bag: Path) -> Iterator[list[McapInput]]:
    """The files of a bag, open.

    Raises:
        BagError: there is none, one of several is missing, or it is no MCAP file.

    Warns:
        UserWarning: the bag was not finished.
    """
    with ExitStack() as stack:
        paths = mcap_files(bag)
        missing = missing_files(bag, paths)
        if missing:
            raise BagError(
                f"bag {bag} lacks {', '.join(missing)}; copy the whole folder again, or save what is there with "
                "`straightcomp recover`"
            )
        files = [stack.enter_context(McapInput(path)) for path in paths]
        for file in files:
            if file.summary is None:
                warnings.warn(
                    f"bag {file.path} was not finished, or its end is damaged: what comes before is read",
                    stacklevel=4,
                )
        yield files
