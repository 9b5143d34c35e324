"""An MCAP file being read: its records one after the other, finished or cut off, and where messages start in a chunk.

The records are walked in the order of the file, which needs no index: a file that was cut off is read the same way
as a finished one. The ``mcap`` package parses single records; where the messages of a whole chunk start, NumPy finds at
once. ``mcap.reader`` gives one message at a time, and ends at the first damage without its place.
Source: MCAP specification (mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC as MAGIC
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError, NoBag
from straightcomp_ros.bags.topics import Definition, Topic

FRAME = struct.Struct("<BQ")
"""Opcode and length, before the content of every record. The length does not count these bytes."""
MESSAGE = struct.Struct("<BQHIQQ")
"""A message record up to the message itself: opcode, length, channel, sequence, log time, publish time."""
_FIELDS = ["opcode", "length", "channel", "sequence", "log_time", "publish_time"]
HEAD = np.dtype({"names": _FIELDS, "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"]})
"""The same for NumPy."""
MESSAGE_FIELDS = MESSAGE.size - FRAME.size
"""Bytes of a message record's content before the message itself."""
UNREADABLE = (McapError, ValueError, OverflowError, struct.error, RuntimeError, MemoryError, zstandard.ZstdError)
"""What the ``mcap`` package and the decompressors raise on damaged records."""
NO_RECORD = "no record starts here, or it is longer than the file"
_DESCRIPTIONS: Mapping[int, type[McapRecord]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
}
_FOOTER_SIZE = FRAME.size + 20
_PRIVATE = 0x80
"""From here on opcodes are private to applications; those between MCAP's last and this are reserved."""
_LARGEST_CHUNK = 1 << 31
"""Bytes of a chunk, unpacked; writers make chunks of a megabyte or so. A damaged size must not fill the memory."""
_LOOSE_SIZE = 1 << 20
"""Bytes of messages outside chunks that make a block."""
_RECOVER = "copy the bag again from where it was recorded, or save what is left with `straightcomp recover`"


Block = tuple[bytes, Mapping[str, NDArray[np.int64]]]
"""Records in memory, and the offsets of each topic's message records in them, ascending."""


class Record(NamedTuple):
    """A record and its offset in the file."""

    opcode: int
    offset: int
    content: bytes


class _Fields(ReadDataStream):  # type: ignore[misc, unused-ignore]  # mcap may have no types
    """The fields of a record, none of which may be longer than what is there."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) != length:
            raise ValueError("a field is longer than its record")
        return data


def measured(kind: type[McapRecord], content: bytes) -> tuple[Any, int]:
    """The record of class ``kind`` in ``content``, and the number of bytes that its fields have; raises one of
    ``UNREADABLE``. Bytes behind its fields are of a later version of MCAP."""
    stream = _Fields(BytesIO(content))
    return kind.read(stream), stream.count


def walked(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of each record in ``data``; ValueError where one is cut off."""
    position, size = 0, len(data)
    while position < size:
        start = position + FRAME.size
        opcode, length = FRAME.unpack_from(data, position) if start <= size else (0, size)
        position = start + length
        if position > size:
            raise ValueError("a record is longer than its place")
        yield opcode, start, position


@dataclass
class Summary:
    """What a file says of itself: its schemas and channels by id, and its statistics."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None

    def add(self, data: bytes) -> Summary:
        """Add the schemas, channels and statistics among the records in ``data``; raises one of ``UNREADABLE``."""
        for opcode, start, end in walked(data):
            if opcode in _DESCRIPTIONS:
                record, _ = measured(_DESCRIPTIONS[opcode], data[start:end])
                if opcode == Opcode.STATISTICS:
                    self.statistics = record
                else:
                    (self.schemas if opcode == Opcode.SCHEMA else self.channels)[record.id] = record
        return self

    @property
    def complete(self) -> bool:
        """Whether the channels and their schemas are all here: a writer need not repeat them at the end of a file."""
        count = self.statistics.channel_count if self.statistics else len(self.channels)
        return bool(self.channels) and all(map(self.describes, self.channels.values())) and count <= len(self.channels)

    def describes(self, channel: Channel) -> bool:
        """Whether the schema of a channel is here, or it has none."""
        return channel.schema_id in (0, *self.schemas)

    def topic(self, channel: Channel) -> Topic:
        """The topic of a channel, with the shipped quality of service."""
        schema = self.schemas.get(channel.schema_id) or Schema(0, b"", "", "")
        is_text = schema.encoding.startswith("ros2")
        text = schema.data.decode(errors="replace") if is_text else schema.data
        described = Definition(text, channel.metadata.get("topic_type_hash", ""), schema.encoding)
        return Topic(channel.topic, schema.name, described=described, encoding=channel.message_encoding)


def rows(data: bytes, positions: NDArray[np.int64], dtype: np.dtype) -> NDArray[np.void]:
    """The ``dtype`` at each position of ``data``, copied into one array; every one must lie inside ``data``."""
    # A view whose items overlap, one for each byte: taking from it is one copy of itemsize bytes an item.
    every_byte = np.ndarray((max(len(data) - dtype.itemsize + 1, 0),), f"V{dtype.itemsize}", data, strides=(1,))
    return every_byte[positions].view(dtype)


def message_places(data: bytes, indexes: Sequence[bytes]) -> Mapping[int, NDArray[np.int64]]:
    """Offsets in ``data``, the records of a chunk, of the message records of each channel, ascending.

    The chunk's message indexes (their contents are in ``indexes``) give them at once, but no checksum covers those.
    They are used only when the records that they point at fill ``data`` without a gap; otherwise the records are walked
    one by one. Raises ValueError when the records do not follow each other up to the end of ``data``.
    """
    starts = _indexed(data, indexes)
    if starts is None:
        contents = [(start, end) for opcode, start, end in walked(data) if opcode == Opcode.MESSAGE]
        if any(end - start < MESSAGE_FIELDS for start, end in contents):
            raise ValueError("a message is too short")
        starts = np.array([start - FRAME.size for start, _ in contents], np.int64)
    channels = rows(data, starts, HEAD)["channel"]
    return {int(channel): starts[channels == channel] for channel in np.unique(channels)}


def _indexed(data: bytes, indexes: Sequence[bytes]) -> NDArray[np.int64] | None:
    """The offsets in the indexes, ascending; None unless messages start there and fill ``data``."""
    # Channel and length, then (log time, offset) of each message; a damaged one may have half an entry.
    entries = b"".join(content[6:][: int.from_bytes(content[2:6], "little")] for content in indexes)
    starts = np.sort(np.frombuffer(entries[: len(entries) // 16 * 16], "<i8")[1::2])
    if not len(starts) or starts[0] != 0 or starts[-1] + HEAD.itemsize > len(data):
        return None
    heads = rows(data, starts, HEAD)
    ends = starts + FRAME.size + heads["length"].astype(np.int64)
    believed = (
        (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["length"] >= MESSAGE_FIELDS).all()
        and (ends[:-1] == starts[1:]).all()
        and ends[-1] == len(data)
    )
    return starts if believed else None


class McapInput:
    """An MCAP file, open. Raises BagError when the file cannot be read, or is not MCAP.

    Attributes:
        summary: what the end of the file says of it; None when the file was not finished, or its end is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = open(path, "rb")  # noqa: SIM115 - closed by __exit__
        except OSError as error:
            raise NoBag(f"bag {path} cannot be read: {error.strerror}; check the path") from error
        self.size = self._file.seek(0, 2)
        start = self.read(0, len(MAGIC))
        if start != MAGIC:
            self._file.close()
            if not start:
                raise BagError(f"bag {path} is empty: the recording was never started; record again")
            raise NoBag(f"bag {path} is not an MCAP file; give a bag folder or a file that ends with .mcap")
        self.summary = self._summary()

    @property
    def finished(self) -> bool:
        """Whether the file has its end, sound."""
        return self.summary is not None

    def damaged(self, offset: int, reason: str) -> BagError:
        """The error for damage at ``offset`` bytes."""
        error = BagError(f"bag {self.path} is damaged at byte {offset}: {reason}; {_RECOVER}")
        error.damage = reason
        return error

    @contextmanager
    def _reading(self, record: Record, what: str) -> Iterator[None]:
        """Turn an error of the block into BagError for damage at ``record``; ``what`` says what cannot be read."""
        try:
            yield
        except BagError:
            raise
        except UNREADABLE as error:
            raise self.damaged(record.offset, f"{what} ({error})") from error

    def frame(self, position: int) -> tuple[int, int] | None:
        """Opcode and end of the record that starts at ``position``; None where none can, or the file ends before it."""
        frame = self.read(position, FRAME.size)
        opcode, length = FRAME.unpack(frame) if len(frame) == FRAME.size else (0, 0)
        end = position + FRAME.size + length
        # Those between MCAP's last opcode and the first private one are reserved.
        possible = Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= _PRIVATE
        return (opcode, end) if possible and end <= self.size else None

    def records(self, *opcodes: Opcode) -> Iterator[Record]:
        """The records of the data section that have one of these opcodes, in the order of the file.

        In an unfinished file the records end before the first one that is not whole; after power was lost this may be
        a chunk of full length whose content never reached the disk. Raises BagError when the records of a finished file
        do not follow each other up to its end.
        """
        position = len(MAGIC)
        while position < self.size:
            found = self.frame(position)
            if found is None:
                if self.summary:
                    raise self.damaged(position, NO_RECORD)
                return
            opcode, end = found
            if opcode in opcodes:
                record = Record(opcode, position, self.read(position + FRAME.size, end - position - FRAME.size))
                if opcode == Opcode.CHUNK and not self.summary:
                    try:
                        self.chunk_data(record)
                    except BagError:
                        return
                yield record
            if opcode == Opcode.DATA_END:
                return
            position = end

    @cached_property
    def topics(self) -> dict[int, Topic]:
        """Topics by the id of their channel: from the summary, from the data where it does not have all. Raises
        BagError when the file is damaged."""
        found = self.summary
        if found is None or not found.complete:
            found = Summary()
            for record in self.records(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK):
                with self._reading(record, "a topic cannot be read"):
                    found.add(self.chunk_data(record) if record.opcode == Opcode.CHUNK else framed(record))
        return {channel.id: found.topic(channel) for channel in found.channels.values()}

    def blocks(self, wanted: Collection[str]) -> Iterator[Block]:
        """All messages in the order of the file, also those of other topics than the ``wanted`` ones: chunk by chunk,
        or some thousand at a time where the file has no chunks. Raises BagError when it is damaged, or a finished file
        holds another number of messages than its statistics say."""
        count = 0
        for offset, data, indexes in self._parts():
            try:
                channels = message_places(data, indexes)
            except ValueError as error:
                raise self.damaged(offset, str(error)) from error
            places: dict[str, NDArray[np.int64]] = {}
            for channel, starts in channels.items():
                if channel not in self.topics:
                    raise self.damaged(0, f"it has messages of a channel {channel} that it does not describe")
                name, count = self.topics[channel].name, count + len(starts)
                # After a merge of bags a topic has several channels.
                places[name] = np.sort(np.append(places[name], starts)) if name in places else starts
            yield data, places
        statistics = self.summary.statistics if self.summary else None
        if statistics and statistics.message_count != count:
            raise self.damaged(0, f"it holds {count} messages, and its statistics say {statistics.message_count}")

    def _parts(self) -> Iterator[tuple[int, bytes, list[bytes]]]:
        """Offset, records and message indexes of each chunk; of messages outside chunks some thousand at a time."""
        offset, indexes, loose, checked = 0, list[bytes](), False, True
        data: bytes | bytearray = b""
        for record in self.records(Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.MESSAGE, Opcode.DATA_END):
            opcode = record.opcode
            # Only a chunk has a checksum of its own, and not every writer computes it.
            checked &= opcode != Opcode.MESSAGE and (opcode != Opcode.CHUNK or any(record.content[24:28]))
            if opcode == Opcode.DATA_END:
                if not checked:
                    self.check_data_section(record)
            elif opcode == Opcode.MESSAGE_INDEX:
                indexes.append(record.content)
            elif opcode == Opcode.MESSAGE and loose and len(data) < _LOOSE_SIZE:
                data += framed(record)
            else:
                if data:
                    yield offset, bytes(data), indexes
                loose = opcode == Opcode.MESSAGE
                data = bytearray(framed(record)) if loose else self.chunk_data(record)
                offset, indexes = record.offset, []
        if data:
            yield offset, bytes(data), indexes

    def chunk_data(self, record: Record) -> bytes:
        """The decompressed records of a chunk. Raises BagError when the checksum differs, the data do not decompress,
        or the compression is unknown."""
        with self._reading(record, "a chunk cannot be unpacked"):
            chunk, _ = measured(Chunk, record.content)
            data = _decompressed(chunk)
        if len(data) != chunk.uncompressed_size:
            raise self.damaged(record.offset, f"a chunk has {len(data)} bytes, not {chunk.uncompressed_size}")
        # rosbag2 writes 0 for «not computed».
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise self.damaged(record.offset, "the checksum of a chunk is wrong")
        return data

    def attachment(self, record: Record) -> Attachment:
        """The attachment in a record. Raises BagError when its checksum is wrong, or it cannot be read."""
        attachment: Attachment
        with self._reading(record, "an attachment cannot be read"):
            attachment, size = measured(Attachment, record.content)
        crc = int.from_bytes(record.content[size - 4 : size], "little")
        if crc and zlib.crc32(record.content[: size - 4]) != crc:
            raise self.damaged(record.offset, "the checksum of an attachment is wrong")
        return attachment

    def attachments(self) -> dict[str, bytes]:
        """The attached files by name, of two with one name the later. Raises BagError when the file is damaged."""
        found = map(self.attachment, self.records(Opcode.ATTACHMENT))
        return {attachment.name: attachment.data for attachment in found}

    def metadata(self) -> Iterator[Metadata]:
        """The metadata records, which have no checksum of their own. Raises BagError when the file is damaged."""
        for end in self.records(Opcode.DATA_END):
            self.check_data_section(end)
        for record in self.records(Opcode.METADATA):
            with self._reading(record, "metadata cannot be read"):
                metadata, _ = measured(Metadata, record.content)
            yield metadata

    def check_data_section(self, end: Record) -> None:
        """Check the checksum over the whole data section, whose ``end`` has it, or 0. Raises BagError when it is
        wrong."""
        expected, position, crc = end.content[:4], 0, 0
        while any(expected) and position < end.offset:
            block = self.read(position, min(1 << 20, end.offset - position))
            position, crc = position + len(block), zlib.crc32(block, crc)
        if any(expected) and crc.to_bytes(4, "little") != expected:
            raise self.damaged(0, "the checksum of the data section is wrong")

    def _summary(self) -> Summary | None:
        end = self.read(max(self.size - len(MAGIC) - _FOOTER_SIZE, 0), _FOOTER_SIZE + len(MAGIC))
        if not end.endswith(MAGIC) or end[: FRAME.size] != FRAME.pack(Opcode.FOOTER, 20):
            return None
        footer = Footer.read(ReadDataStream(BytesIO(end[FRAME.size :])))
        length = self.size - len(MAGIC) - _FOOTER_SIZE - footer.summary_start
        if not footer.summary_start:
            return Summary()
        data = self.read(footer.summary_start, length) if length > 0 else b""
        crc = zlib.crc32(end[: _FOOTER_SIZE - 4], zlib.crc32(data))
        try:
            return Summary().add(data) if length >= 0 and footer.summary_crc in (0, crc) else None
        except UNREADABLE:
            return None

    def read(self, position: int, length: int) -> bytes:
        """Bytes from ``position`` on, fewer at the end of the file."""
        try:
            self._file.seek(position)
            return self._file.read(length)
        except OSError as error:
            where = f"bag {self.path} cannot be read at byte {position}"
            raise BagError(f"{where}: {error.strerror}; {_RECOVER}") from error

    def __enter__(self) -> McapInput:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def framed(record: Record) -> bytes:
    """A record as it is in the file."""
    return FRAME.pack(record.opcode, len(record.content)) + record.content


def _decompressed(chunk: Chunk) -> bytes:
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise ValueError(f"its size is {size} bytes: allowed is up to {_LARGEST_CHUNK}")
    if not chunk.data and not size:
        return b""  # some writers close a chunk without a message, uncompressed
    if chunk.compression == "zstd":
        # What the frame says counts before what it is asked for.
        if zstandard.frame_content_size(chunk.data) > size:
            raise ValueError(f"it has more than its {size} bytes")
        return zstandard.decompress(chunk.data, size)
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    if chunk.compression == "":
        return chunk.data
    raise ValueError(f"compression is '{chunk.compression}': allowed are zstd, lz4 and none")
