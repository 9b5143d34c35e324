"""An MCAP file being written: every record goes whole to the end of the file, the index follows at the end.

Unlike ``mcap.writer.Writer`` a message is added in one step, so that Ctrl-C in the middle of it leaves no half
record in the chunk; a write that fails (disk full) is taken back, so that the file can still be finished; and
the summary names no empty groups. The records themselves are packed by the ``mcap`` package.
"""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags.chunk import ChannelMessage, OpenChunk

LIBRARY = "straightcomp_ros"


class McapOutput:
    """A new MCAP file of profile ``ros2``.

    Args:
        path: the file; must not exist.
        compression: ``zstd``, ``lz4`` or ``none``.
        chunk_size: bytes of messages, before compression, that fill a chunk.

    Raises:
        OSError: from every method that writes; what it wrote is then undone by the next write.
    """

    def __init__(self, path: Path, compression: str, chunk_size: int) -> None:
        self._compression, self._chunk_size = compression, chunk_size
        self._chunk = OpenChunk()
        self._position = self._crc = 0
        self._chunk_started = 0.0
        self._schemas: dict[str, Schema] = {}
        self._channels: list[Channel] = []
        # Packed: as objects they would take 1 KB for each chunk, 20 MB in an hour.
        self._chunk_indexes = bytearray()
        self._chunk_count = 0
        self.time_range: tuple[int, int] | None = None
        """First and last log time in the file in ns; None without messages."""
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self.message_counts: Counter[int] = Counter()
        """Messages in the file, by channel id; those of the open chunk are not in it."""
        self._file = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by close()
        self._position, self._crc = self._put(MAGIC + _packed(Header("ros2", LIBRARY)))

    def add_channel(self, topic: str, type_name: str, definition: str, metadata: dict[str, str]) -> int:
        """Add a topic; returns its channel id.

        It is written beside the chunks, not into one: a damaged chunk then takes its own messages only.
        """
        known = self._schemas.get(type_name)
        schema = known or Schema(len(self._schemas) + 1, definition.encode(), "ros2msg", type_name)
        channel = Channel(len(self._channels) + 1, topic, "cdr", metadata, schema.id)
        end, crc = self._put((b"" if known else _packed(schema)) + _packed(channel))
        # No call from here on: Python serves an interrupt at calls only, so these happen together.
        self._position, self._crc, self._schemas[type_name] = end, crc, schema
        self._channels += [channel]
        return channel.id

    def add_messages(self, messages: Iterable[ChannelMessage]) -> None:
        """Add messages to the open chunk, and write the chunk when it is full."""
        if not self._chunk.records:
            self._chunk_started = time.monotonic()
        self._chunk.add_messages(messages)
        if len(self._chunk.records) >= self._chunk_size:
            self.flush()

    @property
    def chunk_age(self) -> float:
        """Time in s since the first message of the open chunk; 0 without one."""
        return time.monotonic() - self._chunk_started if self._chunk.records else 0.0

    @property
    def size(self) -> int:
        """Bytes of the file, the open chunk not counted."""
        return self._position

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, stamped with the present time."""
        now = time.time_ns()
        record = _packed(Attachment(now, now, name, media_type, data))
        index = AttachmentIndex(self._position, len(record), now, now, len(data), name, media_type)
        end, crc = self._put(record)
        self._position, self._crc = end, crc
        self._attachment_indexes += [index]

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write a metadata record."""
        record = _packed(Metadata(name, dict(metadata)))
        index = MetadataIndex(self._position, len(record), name)
        end, crc = self._put(record)
        self._position, self._crc = end, crc
        self._metadata_indexes += [index]

    @property
    def attachment_count(self) -> int:
        """Attachments in the file."""
        return len(self._attachment_indexes)

    def flush(self) -> None:
        """Write the open chunk, so that only power loss, not the end of the process, can still take it."""
        if not self._chunk.has_messages:
            return
        full = self._chunk.full(self._position, self._compression)
        empty, counts = OpenChunk(), self.message_counts + Counter(full.message_counts)
        index, time_range = _packed(full.index), _widened(self.time_range, full.index)
        end, crc = self._put(full.data)
        # No call from here on: Python serves an interrupt at calls only, so these happen together.
        self._position, self._crc, self._chunk, self.message_counts = end, crc, empty, counts
        self.time_range = time_range
        self._chunk_count += 1
        self._chunk_indexes += index

    def discard_open_chunk(self) -> int:
        """Give up the messages that are not in the file (the disk is full); returns how many."""
        lost = sum(self._chunk.full(0, "none").message_counts.values())
        self._chunk = OpenChunk()
        return lost

    def finish(self) -> None:
        """Write the open chunk, the index and the footer, and make the disk keep it all."""
        self.flush()
        data_end = _packed(DataEnd(self._crc))
        self._put(data_end + self._summary(self._position + len(data_end)))
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _summary(self, start: int) -> bytes:
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, _joined(self._schemas.values())),
            (Opcode.CHANNEL, _joined(self._channels)),
            (Opcode.STATISTICS, _packed(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _joined(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _joined(self._metadata_indexes)),
        ]
        packed = [(opcode, data) for opcode, data in groups if data]
        offsets, position = [], start
        for opcode, data in packed:
            offsets.append(SummaryOffset(opcode, position, len(data)))
            position += len(data)
        summary = b"".join(data for _, data in packed) + _joined(offsets)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, position), zlib.crc32(summary))
        return summary + _packed(Footer(start, position, crc)) + MAGIC

    def _statistics(self) -> Statistics:
        first, last = self.time_range or (0, 0)
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts={channel.id: self.message_counts[channel.id] for channel in self._channels},
            chunk_count=self._chunk_count,
            message_count=sum(self.message_counts.values()),
            message_end_time=last,
            message_start_time=first,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )

    def _put(self, data: bytes) -> tuple[int, int]:
        """Write at the end; returns the new end and checksum, which count when the caller has stored them.

        What an interrupt or a full disk left behind the end is cut off by the next write.
        """
        self._file.truncate(self._position)
        self._file.seek(self._position)
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        return self._position + len(data), zlib.crc32(data, self._crc)


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _joined(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(_packed, records))


def _widened(range_ns: tuple[int, int] | None, chunk: ChunkIndex) -> tuple[int, int]:
    first, last = range_ns or (chunk.message_start_time, chunk.message_end_time)
    return min(first, chunk.message_start_time), max(last, chunk.message_end_time)
