"""What is whole in an MCAP file, however damaged: its sound records, and the gaps between them.

A record counts as sound when all its fields fill its length exactly and its checksum, where it has one, is right.
Behind damage the walk goes on at the next chunk that is sound, wherever it starts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.mcap_input import McapInput, Record, is_opcode
from straightcomp_ros.bags.mcap_records import FRAME, MESSAGE_FIELDS, UNREADABLE, parsed

_PARSED = {Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
_STEP = 1 << 20
"""Bytes in which a chunk is searched for at once."""


class Gap(NamedTuple):
    """Bytes that belong to no sound record."""

    offset: int
    length: int
    reason: str


def salvaged(file: McapInput) -> Iterator[Record | Gap]:
    """Sound records of the data section in the order of the file, and the gaps between them.

    The content of a chunk is that of its unpacked records. A file that was cut off ends with a gap, or with a record.
    """
    position = len(MAGIC)
    while position < file.size:
        try:
            sound, end = _sound(file, position)
        except UNREADABLE as error:
            end = _next_chunk(file, position + 1)
            yield Gap(position, end - position, _reason(error))
        else:
            if sound.opcode == Opcode.DATA_END:
                return
            yield sound
        position = end


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
    for start in range(position, file.size, _STEP):
        block = file.read(start, _STEP + FRAME.size)
        place = block.find(Opcode.CHUNK)
        while 0 <= place < _STEP:
            # First the cheap question: does its length fit into the file?
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
