"""Makes a finished bag from a cut-off or damaged one.

A record is copied when all its fields fill its length exactly and its checksum, where it has one, is right. Behind
damage the search goes on at the next sound chunk, wherever it starts.
"""

import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.definitions import Definition
from straightcomp_ros.bags.folder import mcap_files, missing_files
from straightcomp_ros.bags.mcap_input import McapInput, Record, is_opcode
from straightcomp_ros.bags.mcap_records import FRAME, MESSAGE_FIELDS, UNREADABLE, Summary, frames, parsed
from straightcomp_ros.bags.qos import TopicQos
from straightcomp_ros.bags.writer import BagWriter

RECOVERY_METADATA = "recovery"
"""Metadata record of a recovered bag: what it was made from, and what was lost."""
_MESSAGE = struct.Struct("<HIQQ")
_PARSED = {Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
_COPIED = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_SEARCH_SIZE = 1 << 20
"""Bytes that are searched for a chunk at once."""


@dataclass
class Recovery:
    """What was saved of a bag, and what was lost.

    Attributes:
        output: folder of the new bag.
        saved: messages in the new bag, by topic.
        lost: messages that are missing from it, by topic; None where the damaged bag did not say how many it had.
        gaps: (file name, offset, bytes, reason) of what could not be read.
        unfinished: names of the files that the recording did not finish, or whose end is damaged.
        foreign: topics that are not copied, since their messages are of no ROS 2 type.
        first_ns, last_ns: first and last log time in the new bag, ns since the epoch; None without messages.
    """

    output: Path
    saved: Counter[str] = field(default_factory=Counter)
    lost: dict[str, int] | None = field(default_factory=dict)
    gaps: list[tuple[str, int, int, str]] = field(default_factory=list)
    unfinished: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def whole(self) -> bool:
        """True when nothing was wrong with the bag."""
        return not self.gaps and not self.unfinished and self.lost is not None and not any(self.lost.values())


def recover(bag: Path, output: Path) -> Recovery:
    """Copy all messages, attachments and metadata that are sound in ``bag`` to a new bag ``output`` of one file; the
    original is only read. Raises BagError when there is no MCAP file, or the new bag cannot be written."""
    bag, output = Path(bag), Path(output)
    paths = mcap_files(bag)
    with McapInput(paths[0]):  # refuses what is no MCAP file before a folder is made
        pass
    result = Recovery(output)
    with BagWriter(output) as writer:
        for path in paths:
            with McapInput(path) as file:
                _Copy(file, writer, result).run()
        for name in missing_files(bag, paths):
            result.gaps.append((name, 0, 0, "the file is missing"))
            result.lost = None
        missing = "unknown" if result.lost is None else str(sum(result.lost.values()))
        facts = {"source": str(bag), "saved_messages": str(result.saved.total()), "lost_messages": missing}
        writer.add_metadata(RECOVERY_METADATA, {**facts, "gaps": str(len(result.gaps))})
    return result


class _Copy:
    """Copies the sound records of one file."""

    def __init__(self, file: McapInput, writer: BagWriter, result: Recovery) -> None:
        self._file, self._writer, self._result = file, writer, result
        self._saved: Counter[str] = Counter()
        self._topics: dict[int, str] = {}
        # The end of a finished file names all topics, also those whose own records are damaged.
        self._known = file.summary or Summary()
        self._add_new_topics()

    def run(self) -> None:
        file, position = self._file, len(MAGIC)
        while position < file.size:
            try:
                record, end = _sound(file, position)
            except UNREADABLE as error:
                end = _next_chunk(file, position + 1)
                self._add_gap(position, end - position, _reason(error))
            else:
                if record.opcode == Opcode.DATA_END:
                    break
                self._add(record)
            position = end
        self._count_lost()

    def _add_gap(self, offset: int, length: int, reason: str) -> None:
        self._result.gaps.append((self._file.path.name, offset, length, reason))

    def _add(self, record: Record) -> None:
        # The writer makes metadata.yaml and the record rosbag2 anew.
        if record.opcode == Opcode.ATTACHMENT:
            attachment = parsed(Attachment, record.content)
            if attachment.name != "metadata.yaml":
                self._writer.attach(attachment.name, attachment.media_type, attachment.data)
        elif record.opcode == Opcode.METADATA:
            metadata = parsed(Metadata, record.content)
            if metadata.name != "rosbag2":
                self._writer.add_metadata(metadata.name, metadata.metadata)
        elif record.opcode == Opcode.CHUNK:
            self._add_records(frames(record.content, _COPIED), record, "the rest of a chunk")
        elif record.opcode in _COPIED:
            self._add_records([(record.opcode, record.content)], record, "a record")

    def _add_records(self, records: Iterable[tuple[int, bytes]], origin: Record, what: str) -> None:
        try:
            for opcode, content in records:
                if opcode == Opcode.MESSAGE:
                    self._add_message(content)
                else:
                    self._known.add(opcode, content)
                    self._add_new_topics()
        except UNREADABLE as error:
            self._add_gap(origin.offset, len(origin.content), f"{what} cannot be read ({error})")

    def _add_new_topics(self) -> None:
        for channel in [channel for channel in self._known.channels.values() if channel.id not in self._topics]:
            schema = self._known.schemas.get(channel.schema_id)
            if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
                if channel.topic not in self._result.foreign:
                    self._result.foreign.append(channel.topic)
                continue
            if channel.topic not in self._writer.topics:
                described = Definition(schema.data.decode(), channel.metadata.get("topic_type_hash", ""))
                qos = TopicQos.from_yaml(channel.metadata.get("offered_qos_profiles", ""))
                self._writer.add_topic(channel.topic, schema.name, qos, described)
            self._topics[channel.id] = channel.topic

    def _add_message(self, content: bytes) -> None:
        channel_id, _, log_time, publish_time = _MESSAGE.unpack_from(content)
        topic = self._topics.get(channel_id)
        if topic is None:
            if channel_id in self._known.channels:
                return
            raise ValueError(f"a message of channel {channel_id}, which the file does not describe")
        self._writer.write(topic, content[_MESSAGE.size :], log_time, publish_time)
        self._saved[topic] += 1
        result = self._result
        result.first_ns = log_time if result.first_ns is None else min(result.first_ns, log_time)
        result.last_ns = log_time if result.last_ns is None else max(result.last_ns, log_time)

    def _count_lost(self) -> None:
        result, summary = self._result, self._file.summary
        result.saved.update(self._saved)
        if summary is None:
            result.unfinished.append(self._file.path.name)
        if summary is None or summary.statistics is None or result.lost is None:
            result.lost = None
            return
        for channel_id, expected in summary.statistics.channel_message_counts.items():
            topic = self._topics.get(channel_id)
            if topic is not None:
                result.lost[topic] = result.lost.get(topic, 0) + expected - self._saved[topic]


def default_output(bag: Path) -> Path:
    """Where the recovered bag goes when no folder is named: beside the original. Raises BagError when the place is
    taken."""
    bag = Path(bag).absolute()
    output = bag.with_name(f"{bag.stem if bag.is_file() else bag.name}_recovered")
    if output.exists():
        raise BagError(f"bag {output} is there already; name another folder with -o")
    return output


def _sound(file: McapInput, position: int) -> tuple[Record, int]:
    """The record that starts here, and its end; raises one of ``UNREADABLE`` when none does that is sound."""
    frame = file.read(position, FRAME.size)
    if len(frame) < FRAME.size:
        raise ValueError("the file is cut off")
    opcode, length = FRAME.unpack(frame)
    end = position + FRAME.size + length
    if not is_opcode(opcode):
        raise ValueError("no record starts here")
    if end > file.size:
        raise ValueError("the file is cut off, or a length is wrong")
    record = Record(opcode, position, file.read(position + FRAME.size, length))
    return record._replace(content=_checked(file, record)), end


def _checked(file: McapInput, record: Record) -> bytes:
    """The content of a record, of a chunk its unpacked records; raises one of ``UNREADABLE`` when it is not sound."""
    opcode, content = record.opcode, record.content
    if opcode == Opcode.CHUNK:
        return file.chunk_data(record)
    if opcode == Opcode.ATTACHMENT:
        file.attachment(record)
    elif opcode in _PARSED:
        parsed(_PARSED[Opcode(opcode)], content, whole=True)
    elif opcode == Opcode.MESSAGE_INDEX:
        if len(content) < 6 or int.from_bytes(content[2:6], "little") != len(content) - 6:
            raise ValueError("an index's length is wrong")
    elif opcode == Opcode.MESSAGE and len(content) < MESSAGE_FIELDS:
        raise ValueError("a message is too short")
    elif opcode == Opcode.DATA_END and len(content) != 4:
        raise ValueError("no record starts here")
    return content


def _next_chunk(file: McapInput, position: int) -> int:
    """Offset of the next sound chunk, or the end of the file."""
    for start in range(position, file.size, _SEARCH_SIZE):
        block = file.read(start, _SEARCH_SIZE + FRAME.size)
        place = block.find(Opcode.CHUNK)
        while 0 <= place < _SEARCH_SIZE:
            # Its length first: that costs nothing, and most places fail there.
            length = int.from_bytes(block[place + 1 : place + FRAME.size], "little")
            if length <= file.size - start - place - FRAME.size:
                try:
                    _sound(file, start + place)
                    return start + place
                except UNREADABLE:
                    pass
            place = block.find(Opcode.CHUNK, place + 1)
    return file.size


def _reason(error: Exception) -> str:
    """The middle of a BagError: what is wrong, without the file before and the advice behind."""
    text = str(error)
    return text.split(": ", 1)[1].rsplit(";", 1)[0] if isinstance(error, BagError) and ": " in text else text
