"""Where the messages of each channel stand in a block of MCAP records.

A chunk's message indexes say it at once, but no checksum covers them. They are therefore believed only when the
records that they point at fill the block without a gap; otherwise the records are walked one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""A message record up to the message itself."""
FRAME_SIZE = 9
"""Bytes of opcode and length, which the length does not count."""
_HEAD = struct.Struct("<BQH")
_INDEX_HEAD = struct.Struct("<HI")


def rows(data: bytes, positions: NDArray[np.int64], dtype: np.dtype) -> NDArray[np.void]:
    """The ``dtype`` at each position of ``data``, copied into one array; every one must lie inside ``data``."""
    # A view whose items overlap, one for each byte: taking from it is one copy of itemsize bytes an item.
    every_byte = np.ndarray((max(len(data) - dtype.itemsize + 1, 0),), f"V{dtype.itemsize}", data, strides=(1,))
    return every_byte[positions].view(dtype)


def message_places(data: bytes, indexes: Sequence[bytes]) -> Mapping[int, NDArray[np.int64]]:
    """Offsets in ``data`` of the message records of each channel, ascending.

    Args:
        data: records, as in a chunk.
        indexes: contents of the chunk's message index records; may be empty.

    Raises:
        ValueError: the records do not follow each other up to the end of ``data``.
    """
    places = _parsed(indexes, len(data))
    if places and _fill(data, places):
        return places
    walked, end = _walked(data, len(data))
    if end != len(data):
        raise ValueError("a record is longer than its place")
    return {channel: np.array(offsets, np.int64) for channel, offsets in walked.items()}


def _parsed(indexes: Sequence[bytes], size: int) -> dict[int, NDArray[np.int64]]:
    places: dict[int, NDArray[np.int64]] = {}
    for content in indexes:
        if len(content) < _INDEX_HEAD.size or (len(content) - _INDEX_HEAD.size) % 16:
            return {}
        channel, _ = _INDEX_HEAD.unpack_from(content)
        offsets = np.frombuffer(content, "<u8", offset=_INDEX_HEAD.size)[1::2]
        if channel in places or (len(offsets) and offsets.max() + MESSAGE.itemsize > size):
            return {}
        places[channel] = np.sort(offsets.astype(np.int64))
    return places


def _fill(data: bytes, places: Mapping[int, NDArray[np.int64]]) -> bool:
    """True when there is a message of the channel at each place, and these fill ``data`` up to its end."""
    offsets = np.concatenate(list(places.values()))
    if not len(offsets):
        return False
    heads = rows(data, offsets, MESSAGE)
    channels = np.repeat(list(places), [len(of_channel) for of_channel in places.values()])
    order = np.argsort(offsets, kind="stable")
    starts = offsets[order]
    ends = starts + FRAME_SIZE + heads["length"][order].astype(np.int64)
    before, end = _walked(data, int(starts[0]))
    return bool(
        not before
        and end == starts[0]
        and (heads["opcode"] == Opcode.MESSAGE).all()
        and (heads["channel"] == channels).all()
        and (ends[:-1] == starts[1:]).all()
        and ends[-1] == len(data)
    )


def _walked(data: bytes, end: int) -> tuple[dict[int, list[int]], int]:
    """Offsets of the messages of each channel among the records that start before ``end``, and where they end."""
    places: dict[int, list[int]] = {}
    position, last = 0, min(end, len(data) - _HEAD.size + 1)
    unpack, frame_size, message = _HEAD.unpack_from, FRAME_SIZE, int(Opcode.MESSAGE)
    shortest = MESSAGE.itemsize - FRAME_SIZE
    while position < last:
        opcode, length, channel = unpack(data, position)
        if opcode == message:
            if length < shortest:
                raise ValueError("a message is too short")
            if channel in places:
                places[channel].append(position)
            else:
                places[channel] = [position]
        position += frame_size + length
    return places, position
