"""MCAP records in memory: their framing, the topics and statistics in them, and where messages start.

The ``mcap`` package parses single records; where the messages of a whole chunk start, NumPy finds at once.
Source: MCAP specification (mcap.dev/spec).
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, McapRecord, Schema, Statistics
from numpy.typing import NDArray

from straightcomp_ros.bags.topics import RecordedTopic

FRAME = struct.Struct("<BQ")
"""Opcode and length, before the content of every record. The length does not count these bytes."""
MESSAGE = struct.Struct("<BQHIQQ")
"""A message record up to the message itself: opcode, length, channel, sequence, log time, publish time."""
_FIELDS = ["opcode", "length", "channel", "sequence", "log_time", "publish_time"]
HEAD = np.dtype({"names": _FIELDS, "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"]})
"""The same for NumPy."""
MESSAGE_FIELDS = MESSAGE.size - FRAME.size
"""Bytes of a message record's content before the message itself."""
_INDEX_FIELDS = 6
"""Bytes of a message index's content before its entries (log time, offset)."""
UNREADABLE = (McapError, ValueError, OverflowError, struct.error)
"""What the ``mcap`` package raises on damaged records."""


class Block(NamedTuple):
    """Records in memory, and the offsets of each topic's message records in them, ascending."""

    data: bytes
    places: Mapping[str, NDArray[np.int64]]


class _Fields(ReadDataStream):  # type: ignore[misc, unused-ignore]  # mcap may have no types
    """The fields of a record, none of which may be longer than what is there."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) != length:
            raise ValueError("a field is longer than its record")
        return data


def parsed(kind: type[McapRecord], content: bytes) -> Any:
    """The record of class ``kind`` in ``content``; raises one of ``UNREADABLE``. Bytes behind its fields are of a later
    version of MCAP."""
    return measured(kind, content)[0]


def measured(kind: type[McapRecord], content: bytes) -> tuple[Any, int]:
    """As :func:`parsed`, and the number of bytes that its fields have."""
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


def frames(data: bytes, opcodes: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of the records in ``data`` with one of these opcodes; ValueError where one is cut off."""
    return ((opcode, data[start:end]) for opcode, start, end in walked(data) if opcode in opcodes)


@dataclass
class Summary:
    """What a file says of itself: its schemas and channels by id, and its statistics."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None

    def add(self, opcode: int, content: bytes) -> None:
        """Add a schema, channel or statistics record; raises one of ``UNREADABLE``."""
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, content)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parsed(Channel, content)
            self.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            self.statistics = parsed(Statistics, content)

    def add_all(self, data: bytes) -> Summary:
        """Add those among the records in ``data``; raises one of ``UNREADABLE``."""
        for opcode, content in frames(data, (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS)):
            self.add(opcode, content)
        return self

    @property
    def complete(self) -> bool:
        """Whether the channels and their schemas are all here: a writer need not repeat them at the end of a file."""
        count = self.statistics.channel_count if self.statistics else len(self.channels)
        described = all(channel.schema_id in (0, *self.schemas) for channel in self.channels.values())
        return bool(self.channels) and described and count <= len(self.channels)

    def topics(self) -> dict[int, RecordedTopic]:
        """The topic of each channel."""
        topics = {}
        for channel in self.channels.values():
            schema = self.schemas.get(channel.schema_id) or Schema(0, b"", "", "")
            text = schema.data.decode(errors="replace")
            topics[channel.id] = RecordedTopic(
                channel.topic, schema.name, channel.message_encoding, text, schema.encoding
            )
        return topics


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
    """The offsets in the indexes, ascending; None unless messages start there and fill ``data`` up to its end."""
    lengths = [int.from_bytes(content[2:_INDEX_FIELDS], "little") for content in indexes]
    entries = [content[_INDEX_FIELDS:][:length] for content, length in zip(indexes, lengths, strict=True)]
    if any(len(of_channel) % 16 for of_channel in entries):
        return None
    offsets = np.sort(np.frombuffer(b"".join(entries), "<u8")[1::2])
    if not len(offsets) or offsets[-1] + HEAD.itemsize > len(data):
        return None
    starts = offsets.astype(np.int64)
    heads = rows(data, starts, HEAD)
    ends = starts + FRAME.size + heads["length"].astype(np.int64)
    try:
        others = [opcode for opcode, _, _ in walked(data[: starts[0]])]
    except ValueError:
        return None
    believed = (
        Opcode.MESSAGE not in others
        and (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["length"] >= MESSAGE_FIELDS).all()
        and (ends[:-1] == starts[1:]).all()
        and ends[-1] == len(data)
    )
    return starts if believed else None
