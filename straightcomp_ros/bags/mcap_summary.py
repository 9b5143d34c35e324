"""What an MCAP file tells of itself: its topics, their schemas, its statistics."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator
from io import BytesIO
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

FRAME = struct.Struct("<BQ")
"""Opcode and length, before the content of every record."""
UNREADABLE = (McapError, ValueError, OverflowError, struct.error)
"""What the ``mcap`` package raises on damaged records."""


class Summary(NamedTuple):
    """What the end of a finished file says about it."""

    statistics: Statistics | None
    schemas: dict[int, Schema]
    channels: dict[int, Channel]


def frames(data: bytes, opcodes: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """(opcode, content) of the records in ``data`` that have one of these opcodes.

    Raises:
        ValueError: a record is longer than the data.
    """
    position = 0
    while position < len(data):
        if position + FRAME.size > len(data):
            raise ValueError("a record is cut off")
        opcode, length = FRAME.unpack_from(data, position)
        position += FRAME.size
        if position + length > len(data):
            raise ValueError("a record is longer than its place")
        if opcode in opcodes:
            yield opcode, data[position : position + length]
        position += length


def parsed_summary(data: bytes) -> Summary:
    """The summary in the bytes between the end of the data and the footer; raises one of ``UNREADABLE``."""
    found = Summary(None, {}, {})
    gather(found, frames(data, (Opcode.SCHEMA, Opcode.CHANNEL)))
    statistics = [content for _, content in frames(data, (Opcode.STATISTICS,))]
    return found._replace(statistics=Statistics.read(ReadDataStream(BytesIO(statistics[0])))) if statistics else found


def gather(found: Summary, records: Iterable[tuple[int, bytes]]) -> None:
    """Add (opcode, content) of schema and channel records; raises one of ``UNREADABLE``."""
    for opcode, content in records:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            found.schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            found.channels[channel.id] = channel
