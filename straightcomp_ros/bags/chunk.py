"""The chunk that is being filled: message records in memory, compressed and indexed when it is full.

Source: MCAP specification (mcap.dev/spec), records Message, Chunk, Message Index and Chunk Index.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = 22
"""Bytes of a message record's content before the message itself."""
_INDEX = struct.Struct("<BQHI")
_INDEX_ENTRY = 16

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
        self._entries: dict[int, list[int]] = {}

    def add_message(self, channel_id: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Append one message; times in ns, not negative."""
        fields = _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_FIELDS + len(data), channel_id, 0, log_time_ns, publish_time_ns)
        record, offset = fields + data, len(self.records)
        entries = self._entries.get(channel_id)
        if entries is None:
            entries = self._entries[channel_id] = []
        # No call from here on: Python serves an interrupt at calls only, so both happen or none.
        self.records += record
        entries += (log_time_ns, offset)

    @property
    def has_messages(self) -> bool:
        """False for an empty chunk: MCAP has no use for one."""
        return any(self._entries.values())

    def full(self, position: int, compression: str) -> FullChunk:
        """Close the chunk for the file offset ``position``; the chunk itself stays as it is."""
        name, compress = COMPRESSORS[compression]
        records = bytes(self.records)
        entries = {channel: flat for channel, flat in self._entries.items() if flat}
        times = [time for flat in entries.values() for time in flat[::2]]
        first, last = (min(times), max(times)) if times else (0, 0)
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
        offsets = {}
        for channel, flat in entries.items():
            offsets[channel] = position + builder.count
            size = len(flat) // 2 * _INDEX_ENTRY
            builder.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size))
            builder.write(struct.pack(f"<{len(flat)}Q", *flat))
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
        counts = {channel: len(flat) // 2 for channel, flat in entries.items()}
        return FullChunk(builder.end(), index, counts)  # type: ignore[no-untyped-call]
