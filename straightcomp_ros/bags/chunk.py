"""The chunk that is being filled: message records in memory, compressed and indexed when it is full.

Source: MCAP specification (mcap.dev/spec), records Message, Chunk, Message Index and Chunk Index.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = 22
"""Bytes of a message record's content before the message itself."""
_FRAME = _MESSAGE.size - _MESSAGE_FIELDS
_INDEX = struct.Struct("<BQHI")
_INDEX_ENTRY = 16

ChannelMessage = tuple[int, int, int, bytes]
"""Channel id, log time and publish time in ns, serialised message."""

COMPRESSORS: Mapping[str, tuple[str, Callable[[bytes], bytes]]] = {
    "zstd": ("zstd", zstandard.ZstdCompressor().compress),
    "lz4": ("lz4", lz4.frame.compress),
    "none": ("", bytes),
}
"""For each choice of compression, MCAP's name of it and the function."""


@dataclass(frozen=True)
class FullChunk:
    """A chunk ready for the file: chunk record and message indexes, the entry of the file's index, counts."""

    data: bytes
    index: ChunkIndex
    message_counts: Mapping[int, int]


class OpenChunk:
    """Messages of one chunk. An interrupt (Ctrl-C) between any two steps leaves whole records only."""

    def __init__(self) -> None:
        self.records = bytearray()
        self._index: list[int] = []  # of each message: channel, log time, offset

    def add_messages(self, messages: Iterable[ChannelMessage]) -> None:
        """Append messages; times in ns, not negative."""
        offset = len(self.records)
        pack = _MESSAGE.pack
        parts: list[bytes] = []
        index: list[int] = []
        for channel_id, log_time_ns, publish_time_ns, data in messages:
            content = _MESSAGE_FIELDS + len(data)
            parts += (pack(Opcode.MESSAGE, content, channel_id, 0, log_time_ns, publish_time_ns), data)
            index += (channel_id, log_time_ns, offset)
            offset += _FRAME + content
        records = b"".join(parts)
        # No call from here on: Python serves an interrupt at calls only, so both happen or none.
        self.records += records
        self._index += index

    @property
    def has_messages(self) -> bool:
        """False for an empty chunk: MCAP has no use for one."""
        return bool(self._index)

    def full(self, position: int, compression: str) -> FullChunk:
        """Close the chunk for the file offset ``position``; the chunk itself stays as it is."""
        name, compress = COMPRESSORS[compression]
        records = bytes(self.records)
        messages = np.array(self._index, dtype="<u8").reshape(-1, 3)
        times = messages[:, 1]
        first, last = (int(times.min()), int(times.max())) if len(times) else (0, 0)
        builder = RecordBuilder()
        compressed = compress(records)
        Chunk(
            compression=name,
            data=compressed,
            message_start_time=first,
            message_end_time=last,
            uncompressed_crc=zlib.crc32(records),
            uncompressed_size=len(records),
        ).write(builder)
        chunk_length = builder.count
        offsets, counts = {}, {}
        for channel in np.unique(messages[:, 0]).tolist():
            entries = messages[messages[:, 0] == channel, 1:].tobytes()
            offsets[channel], counts[channel] = position + builder.count, len(entries) // _INDEX_ENTRY
            builder.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries)
        index = ChunkIndex(
            message_start_time=first,
            message_end_time=last,
            chunk_start_offset=position,
            chunk_length=chunk_length,
            message_index_offsets=offsets,
            message_index_length=builder.count - chunk_length,
            compression=name,
            compressed_size=len(compressed),
            uncompressed_size=len(records),
        )
        return FullChunk(builder.end(), index, counts)  # type: ignore[no-untyped-call]
