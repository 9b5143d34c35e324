"""Messages of all streams with numbers of any bit pattern, and a bag that has them."""

import random
import sqlite3
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from straightcomp_ros.bags.topics import Topic, TopicQos
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import STREAMS

LAYOUTS = {stream.topic: stream.layout for stream in STREAMS}
START_NS = 1_700_000_000_123_456_789


class Written(NamedTuple):
    """One message as it was handed to the writer."""

    topic: str
    data: bytes
    log_time: int
    publish_time: int


@dataclass(frozen=True)
class Recording:
    """A finished bag and its messages."""

    directory: Path
    messages: list[Written]

    @property
    def file(self) -> Path:
        return self.directory / f"{self.directory.name}_0.mcap"


def any_float64(source: random.Random) -> float:
    """A number of any bit pattern: also NaN with payload, infinities, denormal numbers, −0."""
    return struct.unpack("<d", source.randbytes(8))[0]


def messages(count: int) -> list[Written]:
    source, written = random.Random(0), []
    for cycle in range(count):
        stamp = START_NS + 500_000 * cycle
        for stream in STREAMS:
            numbers = [any_float64(source) for _ in stream.layout.columns]
            log_time = stamp + source.randrange(100_000)
            written.append(Written(f"/{stream.topic}", stream.layout.pack(stamp, *numbers), log_time, stamp))
    return written


def write(bag: BagWriter, written: list[Written]) -> None:
    for message in written:
        bag.write(*message)


def records(content: bytes, opcode: int) -> list[int]:
    """Offsets of the records of this kind in an MCAP file."""
    position, found = 8, []
    while position < len(content) - 8:
        found += [position] * (content[position] == opcode)
        position += 9 + int.from_bytes(content[position + 1 : position + 9], "little")
    return found


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk_of(data: bytes, compression: bytes = b"", size: int | None = None) -> tuple[int, bytes]:
    """A chunk without a checksum: ``data`` are its records as they are stored, ``size`` is what it says of their length
    when they are unpacked."""
    head = struct.pack("<QQQII", 7, 7, len(data) if size is None else size, 0, len(compression)) + compression
    return Opcode.CHUNK, head + struct.pack("<Q", len(data)) + data


def chunk(*inside: tuple[int, bytes]) -> tuple[int, bytes]:
    """A chunk with these records, without compression."""
    return chunk_of(b"".join(record(*one) for one in inside))


def mcap_of(*content: tuple[int, bytes], summary: bytes | None = None) -> bytes:
    """A file with these records of the data section, and with this summary or none."""
    parts = (Opcode.HEADER, bytes(8)), *content, (Opcode.DATA_END, bytes(4))
    data = MAGIC + b"".join(record(*one) for one in parts)
    footer = struct.pack("<QQI", 0 if summary is None else len(data), 0, 0)
    return data + (summary or b"") + record(Opcode.FOOTER, footer) + MAGIC


def add_streams(bag: BagWriter) -> None:
    for stream in STREAMS:
        bag.add(Topic(f"/{stream.topic}", stream.layout.type_name, TopicQos(reliability="best_effort")))


def recorded(folder: Path, count: int = 50, **options: Any) -> Recording:
    """``count`` cycles of all streams in a new bag."""
    written = messages(count)
    with BagWriter(folder, **options) as bag:
        add_streams(bag)
        bag.attach("parameters.yaml", "application/yaml", b"rate: 2000\n")
        bag.add_metadata("survey", {"guide": "synthetic", "points": "177"})
        write(bag, written)
    return Recording(folder, written)


def sqlite_bag(
    path: Path, topics: dict[str, str], rows: list[tuple[str, int, bytes]], definitions: Sequence[Any] = ()
) -> Path:
    """A file of SQLite as rosbag2 makes them; a topic whose name ends with + is there twice."""
    with sqlite3.connect(path) as connection:
        run = connection.execute
        run("CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles)")
        run("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        ids = {name: number for number, name in enumerate(topics, 1)}
        for name, number in ids.items():
            run("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (number, name.rstrip("+"), topics[name]))
        for name, time_ns, data in rows:
            run("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", (ids[name], time_ns, data))
        if definitions:
            run("CREATE TABLE message_definitions (id, topic_type, encoding, encoded_message_definition, hash)")
            for one in definitions:
                run("INSERT INTO message_definitions VALUES (NULL, ?, ?, ?, '')", one)
    connection.close()
    return path


def described(bag: Path, **information: object) -> Path:
    """The folder of a bag, whose metadata.yaml says this."""
    (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return bag


def information(bag: Path) -> dict[str, Any]:
    """What metadata.yaml says of a bag."""
    return yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
