"""The messages of an MCAP file in blocks: chunk by chunk, or some thousand at a time where it has no chunks."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from straightcomp_ros.bags.mcap_input import McapInput, Record
from straightcomp_ros.bags.places import message_places

_LOOSE_SIZE = 1 << 20
"""Bytes of messages outside chunks that make a block."""


@dataclass(frozen=True)
class Block:
    """Records in memory, and the offsets of each channel's message records in them."""

    data: bytes
    places: Mapping[int, NDArray[np.int64]]


def blocks(file: McapInput) -> Iterator[Block]:
    """All messages of a file in the order of the file.

    Raises:
        BagError: damage; or a finished file holds another number of messages than its statistics say.
    """
    count = 0
    for part in _parts(file):
        try:
            block = Block(part.data, message_places(part.data, part.indexes))
        except ValueError as error:
            raise file.damaged(part.offset, str(error)) from error
        count += sum(len(places) for places in block.places.values())
        yield block
    statistics = file.summary.statistics if file.summary else None
    if statistics and statistics.message_count != count:
        raise file.damaged(0, f"it holds {count} messages, and its statistics say {statistics.message_count}")


@dataclass
class _Part:
    data: bytes
    offset: int
    indexes: list[bytes] = field(default_factory=list)


def _parts(file: McapInput) -> Iterator[_Part]:
    chunk: _Part | None = None
    loose, loose_offset = bytearray(), 0
    for record in file.records(Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.MESSAGE):
        if record.opcode == Opcode.MESSAGE_INDEX:
            if chunk:
                chunk.indexes.append(record.content)
            continue
        if chunk:
            yield chunk
            chunk = None
        if record.opcode == Opcode.CHUNK:
            chunk = _Part(file.chunk_data(record), record.offset)
        else:
            loose_offset = loose_offset if loose else record.offset
            loose += _framed(record)
        if loose and (chunk or len(loose) >= _LOOSE_SIZE):
            yield _Part(bytes(loose), loose_offset)
            loose.clear()
    if chunk:
        yield chunk
    if loose:
        yield _Part(bytes(loose), loose_offset)


def _framed(record: Record) -> bytes:
    return struct.pack("<BQ", record.opcode, len(record.content)) + record.content
