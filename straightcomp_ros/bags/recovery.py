"""Makes a finished bag from a cut-off or damaged one.

A record is copied when its fields fit into its length and its checksum, where it has one, is right. What fields leave
of a length may be of a later version of MCAP, if another record follows. Behind damage the search goes on at the next
sound chunk, wherever it starts.
"""

import shutil
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import compressed_messages, found_files
from straightcomp_ros.bags.mcap_input import (
    FRAME,
    MESSAGE_FIELDS,
    UNREADABLE,
    McapInput,
    Record,
    Summary,
    frames,
    is_opcode,
    measured,
    parsed,
)
from straightcomp_ros.bags.reader import COMPRESSIONS
from straightcomp_ros.bags.topics import Definition, TopicQos
from straightcomp_ros.bags.writer import BagWriter

RECOVERY_METADATA = "recovery"
"""Metadata record of a recovered bag: what it was made from, and what was lost."""
_MESSAGE = struct.Struct("<HIQQ")
_PARSED = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.CHUNK: Chunk,
}
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
        not_copied: topics with messages of a further type or encoding, which are not copied: a topic has one.
        first_ns, last_ns: first and last log time in the new bag, ns since the epoch; None without messages.
    """

    output: Path
    saved: Counter[str] = field(default_factory=Counter)
    lost: dict[str, int] | None = field(default_factory=dict)
    gaps: list[tuple[str, int, int, str]] = field(default_factory=list)
    unfinished: list[str] = field(default_factory=list)
    not_copied: list[str] = field(default_factory=list)
    first_ns: int | None = None
    last_ns: int | None = None

    @property
    def whole(self) -> bool:
        """True when nothing was wrong with the bag, and the copy has all of it."""
        lost = self.lost is None or any(self.lost.values())
        return not (self.gaps or self.unfinished or self.not_copied or lost)


def recover(bag: Path, output: Path) -> Recovery:
    """Copy all messages, attachments and metadata that are sound in ``bag`` to a new bag ``output`` of one file; the
    original is only read. Raises BagError when there is no MCAP file, or the new bag cannot be written."""
    bag, output = Path(bag), Path(output)
    paths, missing_files = found_files(bag)
    if paths[0].suffix == ".db3":
        raise BagError(f"bag {bag} is stored as sqlite3; this needs MCAP: `ros2 bag convert`")
    with McapInput(paths[0]):  # refuses what is no MCAP file before a folder is made
        pass
    result = Recovery(output)
    with _new_bag(result) as writer:
        for path in paths:
            with McapInput(path) as file:
                _Copy(file, writer, result).run()
        for name in missing_files:
            result.gaps.append((name, 0, 0, "the file is missing"))
            result.lost = None
        missing = "unknown" if result.lost is None else str(sum(result.lost.values()))
        facts = {"source": str(bag), "saved_messages": str(result.saved.total()), "lost_messages": missing}
        writer.add_metadata(RECOVERY_METADATA, {**facts, "gaps": str(len(result.gaps))})
    return result


@contextmanager
def _new_bag(result: Recovery) -> Iterator[BagWriter]:
    """A new bag, which is removed again when the original is refused before anything was copied."""
    writer = BagWriter(result.output)
    try:
        with writer:
            yield writer
    except BagError:
        if not result.saved:
            shutil.rmtree(result.output)
        raise


class _Copy:
    """Copies the sound records of one file."""

    def __init__(self, file: McapInput, writer: BagWriter, result: Recovery) -> None:
        self._file, self._writer, self._result = file, writer, result
        self._saved: Counter[int] = Counter()
        self._topics: dict[int, str | None] = {}
        # The end of a finished file names all topics, also those whose own records are damaged.
        self._known = file.summary or Summary()
        self._gaps_before = len(result.gaps)
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
                    self._check(record)
                    break
                self._add(record)
            position = end
        for channel_id in self._known.channels:
            self._topic(channel_id)
        self._count_lost()

    def _check(self, end: Record) -> None:
        """Where nothing is damaged by itself, whether the whole is as it was written."""
        if len(self._result.gaps) == self._gaps_before:
            try:
                self._file.check_data_section(end)
            except BagError as error:
                self._add_gap(0, 0, f"{_reason(error)}: what is not in chunks may be altered")

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
                    new = Summary()
                    new.add(opcode, content)
                    # The end of the file has a checksum, and counts before these.
                    self._known.schemas = new.schemas | self._known.schemas
                    self._known.channels = new.channels | self._known.channels
                    self._add_new_topics()
        except BagError:
            raise  # the new bag cannot be written, or the whole bag is of no use
        except UNREADABLE as error:
            self._add_gap(origin.offset, len(origin.content), f"{what} cannot be read ({error})")

    def _add_new_topics(self) -> None:
        for channel in list(self._known.channels.values()):
            if channel.schema_id in (0, *self._known.schemas):
                self._topic(channel.id)

    def _topic(self, channel_id: int) -> str | None:
        """The new bag's topic for a channel; None when its messages are of another kind than the topic's."""
        if channel_id in self._topics:
            return self._topics[channel_id]
        channel = self._known.channels.get(channel_id)
        if channel is None:
            raise ValueError(f"a message of channel {channel_id}, which the file does not describe")
        schema = self._known.schemas.get(channel.schema_id) or Schema(0, b"", "", "")
        topic = self._writer.topics.get(channel.topic)
        if topic is None:
            is_text = schema.encoding.startswith("ros2")
            text = schema.data.decode(errors="replace") if is_text else schema.data
            described = Definition(text, channel.metadata.get("topic_type_hash", ""), schema.encoding)
            qos = TopicQos.from_yaml(channel.metadata.get("offered_qos_profiles", ""))
            self._writer.add_topic(channel.topic, schema.name, qos, described, channel.message_encoding)
        same = topic is None or (topic.type_name, topic.encoding) == (schema.name, channel.message_encoding)
        if not same and channel.topic not in self._result.not_copied:
            self._result.not_copied.append(channel.topic)
        self._topics[channel_id] = channel.topic if same else None
        return self._topics[channel_id]

    def _add_message(self, content: bytes) -> None:
        channel_id, _, log_time, publish_time = _MESSAGE.unpack_from(content)
        topic = self._topic(channel_id)
        if topic is None:
            return
        data = content[_MESSAGE.size :]
        if not self._saved[channel_id] and (compression := COMPRESSIONS.get(data[:4])):
            raise BagError(f"bag {self._file.path}: topic '{topic}': {compressed_messages(compression)}")
        self._writer.write(topic, data, log_time, publish_time)
        self._saved[channel_id] += 1
        result = self._result
        result.saved[topic] += 1
        result.first_ns = log_time if result.first_ns is None else min(result.first_ns, log_time)
        result.last_ns = log_time if result.last_ns is None else max(result.last_ns, log_time)

    def _count_lost(self) -> None:
        result, summary = self._result, self._file.summary
        name = self._file.path.name
        if summary is None:
            result.unfinished.append(name)
        statistics = summary.statistics if summary else None
        damaged = len(result.gaps) > self._gaps_before
        if summary is None or (statistics is None and damaged):
            result.lost = None
        if statistics is None or result.lost is None:
            return
        for channel_id, expected in statistics.channel_message_counts.items():
            channel = self._known.channels.get(channel_id)
            topic = channel.topic if channel else f"channel {channel_id} of {name}"
            result.lost[topic] = result.lost.get(topic, 0) + max(expected - self._saved[channel_id], 0)
        if self._saved.total() > statistics.message_count:
            self._add_gap(0, 0, f"its statistics say {statistics.message_count} messages, and it has more")


def default_output(bag: Path) -> Path:
    """Where the recovered bag goes when no folder is named: next to the original. Raises BagError when the place is
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
    content, size = _checked(file, record)
    if size < length and not _starts_record(file, end):
        raise ValueError("a record's length is wrong")
    return record._replace(content=content), end


def _starts_record(file: McapInput, position: int) -> bool:
    """Whether the file ends here, or what looks like a record starts."""
    frame = file.read(position, FRAME.size)
    if len(frame) < FRAME.size:
        return True
    opcode, length = FRAME.unpack(frame)
    return is_opcode(opcode) and position + FRAME.size + length <= file.size


def _checked(file: McapInput, record: Record) -> tuple[bytes, int]:
    """The content of a record, of a chunk its unpacked records, and the bytes of the record's fields; raises one of
    ``UNREADABLE`` when it is not sound."""
    opcode, content = record.opcode, record.content
    size = len(content)
    if opcode in _PARSED:
        _, size = measured(_PARSED[Opcode(opcode)], content)
    if opcode == Opcode.CHUNK:
        content = file.chunk_data(record)
    elif opcode == Opcode.ATTACHMENT:
        file.attachment(record)
    elif opcode == Opcode.MESSAGE_INDEX:
        size = 6 + int.from_bytes(content[2:6], "little")
    elif opcode == Opcode.MESSAGE and size < MESSAGE_FIELDS:
        raise ValueError("a message is too short")
    elif opcode == Opcode.DATA_END:
        size = 4
    if size > len(record.content):
        raise ValueError("a record is shorter than its fields")
    return content, size


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
