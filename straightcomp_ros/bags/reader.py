"""Reads a bag: streams as columns, attachments, metadata."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import opened, topic_names
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.mcap_records import UNREADABLE, parsed
from straightcomp_ros.bags.messages import Messages
from straightcomp_ros.bags.sqlite_input import SqliteInput
from straightcomp_ros.bags.stream_columns import StreamColumns, StreamDecoder
from straightcomp_ros.bags.topics import RecordedTopic, chosen_topics, resolved
from straightcomp_ros.messages.cdr import Layout

__all__ = ["StreamColumns", "read_attachments", "read_metadata", "read_streams"]


def read_streams(
    bag: Path,
    layouts: Mapping[str, Layout],
    remap: Mapping[str, str] | None = None,
    whole: Sequence[Messages] = (),
) -> dict[str, StreamColumns]:
    """Read streams as columns, fast where the messages have the layout, otherwise by the names in them.

    Args:
        bag: rosbag2 folder, or one MCAP file.
        layouts: by topic, relative (``encoder``: ``/encoder``, or else the only ``/…/encoder``) or full.
        remap: for topics of ``layouts`` that are named otherwise in the bag, their names there.
        whole: each gets the messages of its topic as they are, if the bag has that topic.

    Returns:
        By the same topic names; a topic that the bag lacks, or that has no messages, is left out.

    Raises:
        BagError: the bag is absent, empty, damaged, without any message, or its messages are of another kind; a
            relative name fits several topics, or ``remap`` names a topic that the bag lacks.

    Warns:
        UserWarning: the bag was not finished; what is whole is read.
    """
    with opened(bag) as files:
        names = topic_names(files)
        wanted = chosen_topics(layouts, names, str(bag), remap or {})
        decoders = {full: StreamDecoder(f"bag {bag}: topic '{full}'", layouts[key]) for full, key in wanted.items()}
        found = {full: one for one in whole if (full := resolved(one.topic, names, str(bag)))}
        count = 0
        for file in files:
            for topic in file.topics.values():
                if topic.name in wanted:
                    _check_kind(file.path, topic, layouts[wanted[topic.name]])
                elif topic.name in found:
                    found[topic.name].describe(topic)
            for data, places in file.blocks([*wanted, *found]):
                for name, starts in places.items():
                    count += len(starts)
                    if name in wanted:
                        decoders[name].add(data, starts)
                    elif name in found:
                        found[name].add(data, starts)
    finished = ((key, decoders[full].finished()) for full, key in wanted.items())
    streams = {key: columns for key, columns in finished if columns is not None}
    if not streams and any(isinstance(file, SqliteInput) for file in files):
        raise BagError(f"bag {bag} has no messages on {', '.join(layouts)}; its topics are {', '.join(sorted(names))}")
    if not count:
        raise BagError(f"bag {bag} has no messages; record again, and check that the topics are published")
    return streams


def read_attachments(bag: Path) -> dict[str, bytes]:
    """The files attached to a bag, by name; of two with one name the later. A SQLite bag has none. Raises BagError when
    the bag is absent or damaged."""
    found: dict[str, bytes] = {}
    with opened(bag) as files:
        for file in (file for file in files if isinstance(file, McapInput)):
            for record in file.records(Opcode.ATTACHMENT):
                attachment = file.attachment(record)
                found[attachment.name] = attachment.data
    return found


def read_metadata(bag: Path) -> dict[str, dict[str, str]]:
    """The texts of a bag's metadata records, by name of the record and key. A SQLite bag has none. Raises BagError when
    the bag is absent or damaged."""
    found: dict[str, dict[str, str]] = {}
    with opened(bag) as files:
        for file in (file for file in files if isinstance(file, McapInput)):
            # Metadata records have no checksum of their own.
            for end in file.records(Opcode.DATA_END):
                file.check_data_section(end)
            for record in file.records(Opcode.METADATA):
                try:
                    metadata = parsed(Metadata, record.content)
                except UNREADABLE as error:
                    raise file.damaged(record.offset, f"metadata cannot be read ({error})") from error
                found.setdefault(metadata.name, {}).update(metadata.metadata)
    return found


def _check_kind(path: Path, topic: RecordedTopic, layout: Layout) -> None:
    # Some tools write the type without its namespace: sensor_msgs/JointState.
    if layout.type_name not in (topic.type_name, topic.type_name.replace("/", "/msg/", 1)) or topic.encoding != "cdr":
        raise BagError(
            f"bag {path}: topic '{topic.name}' has messages of type '{topic.type_name}' in encoding "
            f"'{topic.encoding}'; allowed is {layout.type_name} in encoding 'cdr'"
        )
