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
from straightcomp_ros.parameters.share import PACKAGE

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
_INDEX = struct.Struct("<BQHI")
_INDEX_ENTRY = 16


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
        self._compression, self._compress = COMPRESSORS[compression]
        self._chunk_size = chunk_size
        # Of the open chunk: its messages, of each its channel, log time and offset, and when the first one came.
        self._records, self._index, self._begun = bytearray(), list[int](), 0.0
        self._schema_ids: dict[tuple[str, Definition], int] = {}
        # Packed: as objects the indexes would take 1 KB for each chunk, 20 MB in an hour.
        self._summary: list[bytes] = []
        self.time_range: tuple[int, int] | None = None
        self.message_counts: Counter[int] = Counter()
        self.size = self._crc = 0
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by close()
        self._append(MAGIC + _packed(records.Header("ros2", PACKAGE)))

    def add_channel(self, topic: Topic, metadata: dict[str, str]) -> int:
        """Add a topic; returns its channel id. One of no type has no schema. It is written between the chunks, not into
        one, so that a damaged chunk costs its own messages only."""
        channel_id, added = len(self._of(Opcode.CHANNEL)) + 1, list[bytes]()
        key = (topic.type_name, topic.definition)
        schema_id = self._schema_ids.get(key, len(self._of(Opcode.SCHEMA)) + 1) if topic.type_name else 0
        if schema_id and key not in self._schema_ids:
            text, _, encoding = topic.definition
            data = text if isinstance(text, bytes) else text.encode()
            added.append(_packed(records.Schema(schema_id, data, encoding, topic.type_name)))
        added.append(_packed(records.Channel(channel_id, topic.name, topic.encoding, metadata, schema_id)))
        self._append(b"".join(added), *added)
        self._schema_ids[key] = schema_id
        return channel_id

    def add_messages(self, messages: Iterable[ChannelMessage]) -> None:
        """Add messages to the open chunk, and write the chunk when it is full."""
        if not self._records:
            self._begun = time.monotonic()
        offset, pack = len(self._records), MESSAGE.pack
        parts: list[bytes] = []
        index: list[int] = []
        for channel_id, log_time_ns, publish_time_ns, data in messages:
            content = MESSAGE_FIELDS + len(data)
            parts += (pack(Opcode.MESSAGE, content, channel_id, 0, log_time_ns, publish_time_ns), data)
            index += (channel_id, log_time_ns, offset)
            offset += FRAME.size + content
        joined = b"".join(parts)
        # No call from here on: Python handles an interrupt at calls only, so both happen or none.
        self._records += joined
        self._index += index
        if len(self._records) >= self._chunk_size:
            self.flush()

    @property
    def chunk_age(self) -> float:
        """Time in s since the first message of the open chunk; 0 without one."""
        return time.monotonic() - self._begun if self._records else 0.0

    def add_attachment(self, name: str, media_type: str, data: bytes, made_ns: int | None = None) -> None:
        """Write an attachment, stamped with the present time or that at which it was made."""
        made_ns = time.time_ns() if made_ns is None else made_ns
        record = _packed(records.Attachment(made_ns, made_ns, name, media_type, data))
        index = records.AttachmentIndex(self.size, len(record), made_ns, made_ns, len(data), name, media_type)
        self._append(record, _packed(index))

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write a metadata record."""
        record = _packed(records.Metadata(name, dict(metadata)))
        self._append(record, _packed(records.MetadataIndex(self.size, len(record), name)))

    @property
    def attachment_count(self) -> int:
        """Attachments in the file."""
        return len(self._of(Opcode.ATTACHMENT_INDEX))

    def flush(self) -> None:
        """Write the open chunk, so that only power loss, not the end of the process, can lose it."""
        if not self._index:
            return
        content, counts = bytes(self._records), self.message_counts.copy()
        compressed = self._compress(content)
        messages = np.array(self._index, dtype="<u8").reshape(-1, 3)
        first, last = int(messages[:, 1].min()), int(messages[:, 1].max())
        shared = {"compression": self._compression, "message_start_time": first, "message_end_time": last}
        shared["uncompressed_size"] = len(content)
        builder = RecordBuilder()
        records.Chunk(**shared, data=compressed, uncompressed_crc=zlib.crc32(content)).write(builder)
        chunk_length, offsets = builder.count, dict[int, int]()
        for channel in np.unique(messages[:, 0]).tolist():
            entries = messages[messages[:, 0] == channel, 1:].tobytes()
            offsets[channel] = self.size + builder.count
            counts[channel] += len(entries) // _INDEX_ENTRY
            builder.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries)
        index = records.ChunkIndex(
            **shared,
            chunk_start_offset=self.size,
            chunk_length=chunk_length,
            message_index_offsets=offsets,
            message_index_length=builder.count - chunk_length,
            compressed_size=len(compressed),
        )
        times = (first, last, *(self.time_range or ()))
        time_range, no_records, no_index = (min(times), max(times)), bytearray(), list[int]()
        self._append(builder.end(), _packed(index))
        # No call since the file grew: Python handles an interrupt at calls only, so all of this happens or none.
        self._records, self._index, self.message_counts = no_records, no_index, counts
        self.time_range = time_range

    def discard_open_chunk(self) -> int:
        """Drop the messages of the open chunk, when the disk is full; returns how many."""
        lost = len(self._index) // 3
        self._records, self._index = bytearray(), []
        return lost

    def finish(self) -> None:
        """Write the open chunk, the index and the footer, and sync the file to the disk."""
        self.flush()
        data_end = _packed(records.DataEnd(self._crc))
        self._append(data_end + self._end_of_file(self.size + len(data_end)))
        os.fsync(self._file.fileno())

    def sync(self) -> None:
        """Bring all that is written to the disk; the open chunk is not."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _of(self, opcode: Opcode) -> list[bytes]:
        """The records of this kind that go into the summary."""
        return [packed for packed in self._summary if packed[0] == opcode]

    def _end_of_file(self, start: int) -> bytes:
        summary, offsets, statistics = b"", b"", _packed(self._statistics())
        for opcode in _SUMMARY_GROUPS:
            if group := statistics if opcode == Opcode.STATISTICS else b"".join(self._of(opcode)):
                offsets += _packed(records.SummaryOffset(opcode, start + len(summary), len(group)))
                summary += group
        end = start + len(summary)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, end), zlib.crc32(summary + offsets))
        return summary + offsets + _packed(records.Footer(start, end, crc)) + MAGIC

    def _statistics(self) -> records.Statistics:
        first, last = self.time_range or (0, 0)
        channels = len(self._of(Opcode.CHANNEL))
        return records.Statistics(
            attachment_count=self.attachment_count,
            channel_count=channels,
            channel_message_counts={channel: self.message_counts[channel] for channel in range(1, channels + 1)},
            chunk_count=len(self._of(Opcode.CHUNK_INDEX)),
            message_count=self.message_counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._of(Opcode.METADATA_INDEX)),
            schema_count=len(self._of(Opcode.SCHEMA)),
        )

    def _append(self, data: bytes, *entries: bytes) -> None:
        """Write at the end, and take up the entries of the summary that belong to it. The next write cuts off what an
        interrupt or a full disk left behind the end."""
        self._file.truncate(self.size)
        self._file.seek(self.size)
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        size, crc = self.size + len(data), zlib.crc32(data, self._crc)
        # No call from here on: Python handles an interrupt at calls only, so both happen or none.
        self.size, self._crc = size, crc
        self._summary += entries


def _packed(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
