"""Makes a finished bag from a cut-off or damaged one.

A record is copied when its fields fit into its length and its checksum, where it has one, is right. What fields leave
of a length may be of a later version of MCAP, if another record follows. Behind damage the search goes on at the next
sound chunk, wherever it starts.
"""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags import BagError, noting_warnings
from straightcomp_ros.bags.folder import compressed_messages, found_files
from straightcomp_ros.bags.mcap_input import (
    FRAME,
    MESSAGE,
    MESSAGE_FIELDS,
    NO_RECORD,
    UNREADABLE,
    McapInput,
    Record,
    Summary,
    framed,
    measured,
    walked,
)
from straightcomp_ros.bags.reader import COMPRESSIONS
from straightcomp_ros.bags.topics import TopicQos
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.parameters.output_files import clear

RECOVERY_METADATA, UNFINISHED_FILES, LOST_FILES = "recovery", "unfinished_files", "lost_files"
"""Metadata record of a recovered bag: what it was made from, and what was lost; its keys of the files that the recorder
had not finished, and of those that are not in the copy at all."""
_PARSED = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.CHUNK: Chunk,
}
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
        lost_files: names of the files that are missing, or cannot be read at all.
        not_copied: topics with messages of a further type or encoding, which are not copied: a topic has one.
        left_out: messages at the beginning that were not to be copied.
        time_range: first and last log time in the new bag, ns since the epoch; None without messages.
    """

    output: Path
    saved: Counter[str] = field(default_factory=Counter)
    lost: dict[str, int] | None = field(default_factory=dict)
    gaps: list[tuple[str, int, int, str]] = field(default_factory=list)
    unfinished: list[str] = field(default_factory=list)
    lost_files: list[str] = field(default_factory=list)
    not_copied: list[str] = field(default_factory=list)
    left_out: int = 0
    time_range: tuple[int, int] | None = None

    def lose(self, name: str, size: int, reason: str) -> None:
        """Count a whole file as lost."""
        self.gaps.append((name, 0, size, reason))
        self.lost_files.append(name)
        self.lost = None

    @property
    def whole(self) -> bool:
        """True when nothing was wrong with the bag, and the copy has all of it."""
        lost = self.lost is None or any(self.lost.values())
        return not (self.gaps or self.unfinished or self.not_copied or lost)


def recover(
    bag: Path, output: Path, *, skip: int = 0, edit: Callable[[str, bytes], bytes] = lambda name, data: data
) -> Recovery:
    """Copy all messages, attachments and metadata that are sound in ``bag`` to a new bag ``output`` of one file; the
    original is only read. The first ``skip`` messages are left out; ``edit`` changes attachments, given their name and
    content. Raises BagError when there is no MCAP file, or the new bag cannot be written."""
    bag, output = Path(bag), Path(output)
    result = Recovery(output)
    with noting_warnings() as left_out:
        paths, missing_files = found_files(bag)
    result.gaps += [(bag.name, 0, 0, text) for text in left_out]
    if paths[0].suffix == ".db3":
        raise BagError(f"bag {bag} is stored as sqlite3; this needs MCAP: `ros2 bag convert`")
    readable, refused = list[Path](), list[BagError]()
    for path in paths:
        try:
            # One at a time: a bag may have more files than a process may open.
            with McapInput(path):
                readable.append(path)
        except BagError as error:
            refused.append(error)
            # What a link that leads nowhere stands for has no size.
            result.lose(path.name, path.stat().st_size if path.exists() else 0, str(error))
    if not readable:
        raise refused[0]
    made, writer = not os.path.exists(output), BagWriter(output)
    try:
        with writer:
            for path in readable:
                with McapInput(path) as file:
                    _Copy(file, writer, result, skip, edit).run()
            for name in missing_files:
                result.lose(name, 0, "the file is missing")
            missing = "unknown" if result.lost is None else str(sum(result.lost.values()))
            facts = {"source": str(bag), "saved_messages": str(result.saved.total()), "lost_messages": missing}
            facts |= {"gaps": str(len(result.gaps)), UNFINISHED_FILES: ", ".join(result.unfinished)}
            facts[LOST_FILES] = ", ".join(result.lost_files)
            writer.add_metadata(RECOVERY_METADATA, facts)
    except BaseException:
        # Half a copy would pass as a whole bag, whatever ended it: Ctrl-C too.
        clear(output, made=made)
        raise
    result.time_range = writer.finished_files[0].time_range
    return result


class _Copy:
    """Copies the sound records of one file."""

    def __init__(
        self,
        file: McapInput,
        writer: BagWriter,
        result: Recovery,
        skip: int,
        edit: Callable[[str, bytes], bytes],
    ) -> None:
        self._file, self._writer, self._result = file, writer, result
        self._skip, self._edit = skip, edit
        self._saved: Counter[int] = Counter()
        self._topics: dict[int, str | None] = {}
        self._known = Summary()
        self._gaps_before = len(result.gaps)
        # The end of a finished file names all topics, also those whose own records are damaged.
        self._learn(file.summary or Summary())

    def run(self) -> None:
        file, position = self._file, len(MAGIC)
        while position < file.size:
            try:
                record, end = _sound(file, position)
            except UNREADABLE as error:
                end = _next_chunk(file, position + 1)
                self._add_gap(position, end - position, getattr(error, "damage", "") or str(error))
            else:
                self._add(record)
                if record.opcode == Opcode.DATA_END:
                    break
            position = end
        for channel_id in self._known.channels:
            self._topic(channel_id)
        self._count_lost()

    @property
    def _damaged(self) -> bool:
        return len(self._result.gaps) > self._gaps_before

    def _add_gap(self, offset: int, length: int, reason: str) -> None:
        self._result.gaps.append((self._file.path.name, offset, length, reason))

    def _add(self, record: Record) -> None:
        opcode, content = record.opcode, record.content
        # The writer makes metadata.yaml and the record rosbag2 anew.
        if opcode == Opcode.ATTACHMENT:
            attachment, _ = measured(Attachment, content)
            if attachment.name != "metadata.yaml":
                data = self._edit(attachment.name, attachment.data)
                made_ns = attachment.create_time or attachment.log_time
                self._writer.attach(attachment.name, attachment.media_type, data, made_ns)
        elif opcode == Opcode.METADATA:
            metadata, _ = measured(Metadata, content)
            if metadata.name != "rosbag2":
                self._writer.add_metadata(metadata.name, metadata.metadata)
        elif opcode == Opcode.CHUNK:
            self._add_records(content, record, "the rest of a chunk")
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            self._add_records(framed(record), record, "a record")
        elif opcode == Opcode.DATA_END and not self._damaged:
            # Where nothing is damaged by itself, the whole may be.
            try:
                self._file.check_data_section(record)
            except BagError as error:
                self._add_gap(0, 0, f"{error.damage}: what is not in chunks may be altered")

    def _add_records(self, data: bytes, origin: Record, what: str) -> None:
        try:
            for opcode, start, end in walked(data):
                if opcode == Opcode.MESSAGE:
                    self._add_message(data[start - FRAME.size : end])
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._learn(Summary().add(data[start - FRAME.size : end]))
        except BagError:
            raise  # the new bag cannot be written, or the whole bag is of no use
        except UNREADABLE as error:
            self._add_gap(origin.offset, len(origin.content), f"{what} cannot be read ({error})")

    def _learn(self, new: Summary) -> None:
        """Add the topics that are known now. The end of the file, learned first, has a checksum, and counts."""
        known = self._known
        known.schemas = new.schemas | known.schemas
        known.channels = new.channels | known.channels
        for channel in known.channels.values():
            if known.describes(channel):
                self._topic(channel.id)

    def _topic(self, channel_id: int) -> str | None:
        """The new bag's topic for a channel; None when its messages are of another kind than the topic's."""
        if channel_id in self._topics:
            return self._topics[channel_id]
        channel = self._known.channels.get(channel_id)
        if channel is None:
            raise ValueError(f"a message of channel {channel_id}, which the file does not describe")
        own = self._known.topic(channel)
        topic = self._writer.topics.get(own.name)
        if topic is None:
            qos = TopicQos.from_yaml(channel.metadata.get("offered_qos_profiles", ""))
            self._writer.add(replace(own, qos=qos))
        same = topic is None or (topic.type_name, topic.encoding) == (own.type_name, own.encoding)
        if not same and own.name not in self._result.not_copied:
            self._result.not_copied.append(own.name)
        self._topics[channel_id] = own.name if same else None
        return self._topics[channel_id]

    def _add_message(self, record: bytes) -> None:
        _, _, channel_id, _, log_time, publish_time = MESSAGE.unpack_from(record)
        left_out = self._result.left_out < self._skip
        self._result.left_out += left_out
        topic = self._topic(channel_id)
        if topic is None:
            return
        data = record[MESSAGE.size :]
        if not self._saved[channel_id] and (compression := COMPRESSIONS.get(data[:4])):
            raise BagError(f"bag {self._file.path}: topic '{topic}': {compressed_messages(compression)}")
        self._saved[channel_id] += 1
        if left_out:
            return
        self._writer.write(topic, data, log_time, publish_time)
        self._result.saved[topic] += 1

    def _count_lost(self) -> None:
        result, summary, name = self._result, self._file.summary, self._file.path.name
        statistics = summary.statistics if summary else None
        if summary is None:
            result.unfinished.append(name)
        if summary is None or (statistics is None and self._damaged):
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
    """The record that starts here, of a chunk with its unpacked records, and its end; raises one of ``UNREADABLE`` when
    none does that is sound."""
    found = file.frame(position)
    if found is None:
        raise ValueError(NO_RECORD)
    opcode, end = found
    content = file.read(position + FRAME.size, end - position - FRAME.size)
    record, size = Record(opcode, position, content), len(content)
    if opcode in _PARSED:
        _, size = measured(_PARSED[Opcode(opcode)], content)
    elif opcode == Opcode.MESSAGE_INDEX:
        size = 6 + int.from_bytes(content[2:6], "little")
    elif opcode in (Opcode.MESSAGE, Opcode.DATA_END):
        size = max(size, MESSAGE_FIELDS) if opcode == Opcode.MESSAGE else 4
    if size > len(content):
        raise ValueError("a record is shorter than its fields")
    if opcode == Opcode.CHUNK:
        record = record._replace(content=file.chunk_data(record))
    elif opcode == Opcode.ATTACHMENT:
        file.attachment(record)
    if size < len(content) and end + FRAME.size <= file.size and file.frame(end) is None:
        raise ValueError("a record's length is wrong")
    return record, end


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
