"""What is whole in an MCAP file, however damaged: its sound records, and the gaps between them.

A record counts as sound when all its fields fill its length exactly and its checksum, where it has one, is right.
Behind damage the walk goes on at the next chunk that is sound, wherever it starts.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.mcap_input import PRIVATE, McapInput, Record, attachment_of
from straightcomp_ros.bags.mcap_summary import FRAME, UNREADABLE

_PARSED = {Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.METADATA: Metadata}
_SHORTEST_MESSAGE = 22


class Gap(NamedTuple):
    """Bytes that belong to no sound record."""

    offset: int
    length: int
    reason: str


class Sound(NamedTuple):
    """A sound record; ``data`` holds the unpacked records of a chunk, and the content of any other record."""

    opcode: int
    offset: int
    data: bytes


def salvaged(file: McapInput) -> Iterator[Sound | Gap]:
    """Sound records of the data section in the order of the file, and the gaps between them.

    A file that was cut off ends with a gap, or with a record.
    """
    position = len(MAGIC)
    while position < file.size:
        try:
            sound, end = _sound(file, position)
        except _Unsound as why:
            end = _next_chunk(file, position + 1)
            yield Gap(position, end - position, str(why))
        else:
            if sound.opcode == Opcode.DATA_END:
                return
            yield sound
        position = end


class _Unsound(Exception):
    """No sound record starts here; the text says why."""


def _sound(file: McapInput, position: int) -> tuple[Sound, int]:
    frame = file.read(position, FRAME.size)
    if len(frame) < FRAME.size:
        raise _Unsound("the file is cut off")
    opcode, length = FRAME.unpack(frame)
    end = position + FRAME.size + length
    if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= PRIVATE):
        raise _Unsound("no record starts here")
    if end > file.size:
        raise _Unsound("the file is cut off, or a length is wrong")
    content = file.read(position + FRAME.size, length)
    try:
        return Sound(opcode, position, _checked(file, Record(opcode, position, content))), end
    except (BagError, *UNREADABLE) as error:
        raise _Unsound(_reason(error)) from error


def _checked(file: McapInput, record: Record) -> bytes:
    opcode, content = record.opcode, record.content
    if opcode == Opcode.CHUNK:
        return file.chunk_data(record)
    if opcode == Opcode.ATTACHMENT:
        attachment_of(file, record)
    elif opcode in _PARSED:
        stream = ReadDataStream(BytesIO(content))
        _PARSED[Opcode(opcode)].read(stream)
        if stream.count != len(content):
            raise ValueError("a record's length is wrong")
    elif opcode == Opcode.MESSAGE_INDEX:
        if len(content) < 6 or struct.unpack_from("<I", content, 2)[0] != len(content) - 6:
            raise ValueError("an index's length is wrong")
    elif opcode == Opcode.MESSAGE and len(content) < _SHORTEST_MESSAGE:
        raise ValueError("a message is too short")
    elif opcode == Opcode.DATA_END and len(content) != 4:
        raise ValueError("no record starts here")
    return content


def _next_chunk(file: McapInput, position: int) -> int:
    """Offset of the next sound chunk, or the end of the file."""
    step = 1 << 20
    while position < file.size:
        block = file.read(position, step + FRAME.size)
        place = block.find(Opcode.CHUNK)
        while 0 <= place < step:
            length = int.from_bytes(block[place + 1 : place + 9], "little")
            if length <= file.size - position - place - FRAME.size:
                try:
                    _sound(file, position + place)
                except _Unsound:
                    pass
                else:
                    return position + place
            place = block.find(Opcode.CHUNK, place + 1)
        position += step
    return file.size


def _reason(error: Exception) -> str:
    """The middle of a BagError: what is wrong, without the file before and the advice behind."""
    text = str(error)
    return text.split(": ", 1)[1].rsplit(";", 1)[0] if isinstance(error, BagError) and ": " in text else text
