"""An MCAP file being written: every record goes whole to the end of the file, the index follows at the end.

The ``mcap`` package packs the records; its ``Writer`` does not serve, for three reasons. Here messages are added in one
step, so that Ctrl-C in the middle leaves no half record in the chunk. A write that fails (disk full) is undone, so that
the file can still be finished. And the summary names no empty groups.
Source: MCAP specification (mcap.dev/spec).
"""

import os
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags.mcap_input import FRAME, MESSAGE, MESSAGE_FIELDS
from straightcomp_ros.bags.topics import Definition, Topic
from straightcomp_ros.contract import PACKAGE

ChannelMessage = tuple[int, int, int, bytes]
"""Channel id, log time and publish time in ns (not negative), serialised message."""

COMPRESSORS: Mapping[str, tuple[str, Callable[[bytes], bytes]]] = {
    "zstd": ("zstd", zstandard.ZstdCompressor().compress),
    "lz4": ("lz4", lz4.frame.compress),
    "none": ("", bytes),
}
"""For each choice of compression, MCAP's name of it and the function."""
_SUMMARY_GROUPS = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)
_FRAME_SIZE = FRAME.size
_INDEX = struct.Struct("<BQHI")
_INDEX_ENTRY = 16


class _OpenChunk:
    """Messages of one chunk in memory."""

    def __init__(self) -> None:
        self.records = bytearray()
        self._index: list[int] = []  # of each message: channel, log time, offset
        self.begun = time.monotonic()

    def add_messages(self, messages: Iterable[ChannelMessage]) -> None:
        offset, pack = len(self.records), MESSAGE.pack
        parts: list[bytes] = []
        index: list[int] = []
        for channel_id, log_time_ns, publish_time_ns, data in messages:
            content = MESSAGE_FIELDS + len(data)
            parts += (pack(Opcode.MESSAGE, content, channel_id, 0, log_time_ns, publish_time_ns), data)
            index += (channel_id, log_time_ns, offset)
            offset += _FRAME_SIZE + content
        joined = b"".join(parts)
        # No call from here on: Python serves an interrupt at calls only, so both happen or none.
        self.records += joined
        self._index += index

    def __len__(self) -> int:
        return len(self._index) // 3

    def closed(self, position: int, compression: str) -> tuple[bytes, records.ChunkIndex, Counter[int]]:
        """Chunk record and message indexes for the file offset ``position``, the chunk's entry in the file's index, and
        the number of messages by channel; the chunk itself, which has messages, stays as it is."""
        name, compress = COMPRESSORS[compression]
        content = bytes(self.records)
        messages = np.array(self._index, dtype="<u8").reshape(-1, 3)
        times = messages[:, 1]
        first, last = int(times.min()), int(times.max())
        builder = RecordBuilder()
        compressed = compress(content)
        shared = {"compression": name, "message_start_time": first, "message_end_time": last}
        shared["uncompressed_size"] = len(content)
        records.Chunk(**shared, data=compressed, uncompressed_crc=zlib.crc32(content)).write(builder)
        chunk_length = builder.count
        offsets, counts = {}, Counter[int]()
        for channel in np.unique(messages[:, 0]).tolist():
            entries = messages[messages[:, 0] == channel, 1:].tobytes()
            offsets[channel], counts[channel] = position + builder.count, len(entries) // _INDEX_ENTRY
            builder.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries)
        index = records.ChunkIndex(
            **shared,
            chunk_start_offset=position,
            chunk_length=chunk_length,
            message_index_offsets=offsets,
            message_index_length=builder.count - chunk_length,
            compressed_size=len(compressed),
        )
        return builder.end(), index, counts


class McapOutput:
    """A new MCAP file of profile ``ros2``, in chunks of ``chunk_size`` bytes of messages before compression.

    Attributes:
        time_range: first and last log time in the file in ns; None without messages.
        message_counts: messages in the file, by channel id; those of the open chunk are not in it.
        size: bytes of the file, the open chunk not counted.

    Raises:
        OSError: from every method that writes; what it wrote is then undone by the next write.
    """

    def __init__(self, path: Path, compression: str, chunk_size: int) -> None:
        self._compression, self._chunk_size = compression, chunk_size
        self._chunk = _OpenChunk()
        self._schema_ids: dict[tuple[str, Definition], int] = {}
        # Packed: as objects the indexes would take 1 KB for each chunk, 20 MB in an hour.
        self._summary: dict[Opcode, list[bytes]] = {opcode: [] for opcode in _SUMMARY_GROUPS}
        self.time_range: tuple[int, int] | None = None
        self.message_counts: Counter[int] = Counter()
        self.size = self._crc = 0
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by close()
        self.size, self._crc = self._put(MAGIC + _packed(records.Header("ros2", PACKAGE)))

    def add_channel(self, topic: Topic, metadata: dict[str, str]) -> int:
        """Add a topic; returns its channel id. One of no type has no schema. It is written between the chunks, not into
        one, so that a damaged chunk costs its own messages only."""
        schemas, channels = self._summary[Opcode.SCHEMA], self._summary[Opcode.CHANNEL]
        key = (topic.type_name, topic.definition)
        schema_id = self._schema_ids.get(key, len(schemas) + 1) if topic.type_name else 0
        text, _, encoding = topic.definition
        data = text if isinstance(text, bytes) else text.encode()
        known = key in self._schema_ids or not schema_id
        schema = [] if known else [_packed(records.Schema(schema_id, data, encoding, topic.type_name))]
        channel = [_packed(records.Channel(len(channels) + 1, topic.name, topic.encoding, metadata, schema_id))]
        end, crc = self._put(b"".join(schema + channel))
        # No call from here on: Python serves an interrupt at calls only, so these happen together.
        self.size, self._crc, self._schema_ids[key] = end, crc, schema_id
        schemas += schema
        channels += channel
        return len(channels)

    def add_messages(self, messages: Iterable[ChannelMessage]) -> None:
        """Add messages to the open chunk, and write the chunk when it is full."""
        if not self._chunk.records:
            self._chunk.begun = time.monotonic()
        self._chunk.add_messages(messages)
        if len(self._chunk.records) >= self._chunk_size:
            self.flush()

    @property
    def chunk_age(self) -> float:
        """Time in s since the first message of the open chunk; 0 without one."""
        return time.monotonic() - self._chunk.begun if self._chunk.records else 0.0

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, stamped with the present time."""
        now = time.time_ns()
        record = _packed(records.Attachment(now, now, name, media_type, data))
        index = records.AttachmentIndex(self.size, len(record), now, now, len(data), name, media_type)
        self._add_indexed(record, Opcode.ATTACHMENT_INDEX, index)

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write a metadata record."""
        record = _packed(records.Metadata(name, dict(metadata)))
        self._add_indexed(record, Opcode.METADATA_INDEX, records.MetadataIndex(self.size, len(record), name))

    def _add_indexed(self, record: bytes, group: Opcode, index: records.McapRecord) -> None:
        entries, entry = self._summary[group], [_packed(index)]
        end, crc = self._put(record)
        self.size, self._crc = end, crc
        entries += entry

    @property
    def attachment_count(self) -> int:
        """Attachments in the file."""
        return len(self._summary[Opcode.ATTACHMENT_INDEX])

    def flush(self) -> None:
        """Write the open chunk, so that only power loss, not the end of the process, can lose it."""
        if not self._chunk:
            return
        data, index, in_chunk = self._chunk.closed(self.size, self._compression)
        empty, counts = _OpenChunk(), self.message_counts + in_chunk
        times = (index.message_start_time, index.message_end_time, *(self.time_range or ()))
        time_range = min(times), max(times)
        entries, entry = self._summary[Opcode.CHUNK_INDEX], [_packed(index)]
        end, crc = self._put(data)
        # No call from here on: Python serves an interrupt at calls only, so these happen together.
        self.size, self._crc, self._chunk, self.message_counts = end, crc, empty, counts
        self.time_range = time_range
        entries += entry

    def discard_open_chunk(self) -> int:
        """Drop the messages of the open chunk, when the disk is full; returns how many."""
        lost = len(self._chunk)
        self._chunk = _OpenChunk()
        return lost

    def finish(self) -> None:
        """Write the open chunk, the index and the footer, and sync the file to the disk."""
        self.flush()
        data_end = _packed(records.DataEnd(self._crc))
        self._put(data_end + self._end_of_file(self.size + len(data_end)))
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _end_of_file(self, start: int) -> bytes:
        summary, offsets = b"", b""
        for opcode, packed in {**self._summary, Opcode.STATISTICS: [_packed(self._statistics())]}.items():
            if packed:
                group = b"".join(packed)
                offsets += _packed(records.SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        end = start + len(summary)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, end), zlib.crc32(summary + offsets))
        return summary + offsets + _packed(records.Footer(start, end, crc)) + MAGIC

    def _statistics(self) -> records.Statistics:
        first, last = self.time_range or (0, 0)
        channels = len(self._summary[Opcode.CHANNEL])
        return records.Statistics(
            attachment_count=self.attachment_count,
            channel_count=channels,
            channel_message_counts={channel: self.message_counts[channel] for channel in range(1, channels + 1)},
            chunk_count=len(self._summary[Opcode.CHUNK_INDEX]),
            message_count=self.message_counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._summary[Opcode.METADATA_INDEX]),
            schema_count=len(self._summary[Opcode.SCHEMA]),
        )

    def _put(self, data: bytes) -> tuple[int, int]:
        """Write at the end; returns the new end and checksum, which count when the caller has stored them. The next
        write cuts off what an interrupt or a full disk left behind the end."""
        self._file.truncate(self.size)
        self._file.seek(self.size)
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        return self.size + len(data), zlib.crc32(data, self._crc)


def _packed(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
