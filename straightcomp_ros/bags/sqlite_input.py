"""Bags that rosbag2 stored as SQLite, as messages in MCAP's own framing: one decoder then serves both.

Source: rosbag2_storage_sqlite3, tables `topics` (id, name, type, serialization_format, …) and `messages` (topic_id,
timestamp in ns, data). It stores the time of reception only, which stands for the publish time too.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import split_number

_FRAME = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = 22
_AT_ONCE = 5000


class SqliteTopic(NamedTuple):
    """A topic: full name, ROS type, serialisation (``cdr``)."""

    name: str
    type_name: str
    encoding: str


def sqlite_files(bag: Path) -> list[Path]:
    """The SQLite files of a bag, oldest first; none for another bag."""
    bag = Path(bag)
    if bag.is_file():
        return [bag] if bag.suffix == ".db3" else []
    return [] if any(bag.glob("*.mcap")) else sorted(bag.glob("*.db3"), key=split_number)


def sqlite_topics(path: Path) -> dict[int, SqliteTopic]:
    """Topics by id.

    Raises:
        BagError: the file is no bag, or is damaged.
    """
    rows = _query(path, "SELECT id, name, type, serialization_format FROM topics")
    return {row[0]: SqliteTopic(*row[1:]) for row in rows}


def sqlite_blocks(path: Path, topic_id: int) -> Iterator[tuple[bytes, NDArray[np.int64]]]:
    """Messages of a topic in the order in which they were recorded: MCAP message records, and their offsets.

    Raises:
        BagError: the file is damaged.
    """
    records: list[bytes] = []
    rows = _query(path, "SELECT timestamp, data FROM messages WHERE topic_id = ? ORDER BY timestamp, id", topic_id)
    for time_ns, data in rows:
        if not isinstance(data, bytes) or not isinstance(time_ns, int) or time_ns < 0:
            raise _refused(path, "a message has no data, or no time")
        records.append(_FRAME.pack(Opcode.MESSAGE, _MESSAGE_FIELDS + len(data), 0, 0, time_ns, time_ns) + data)
        if len(records) == _AT_ONCE:
            yield _block(records)
            records = []
    if records:
        yield _block(records)


def _block(records: list[bytes]) -> tuple[bytes, NDArray[np.int64]]:
    sizes = np.array([len(record) for record in records], np.int64)
    return b"".join(records), np.cumsum(sizes) - sizes


def _query(path: Path, statement: str, *values: int) -> Iterator[tuple]:
    try:
        # Read only: opening must not make files beside somebody else's bag.
        with closing(sqlite3.connect(f"{Path(path).absolute().as_uri()}?mode=ro", uri=True)) as connection:
            yield from connection.execute(statement, values)
    except sqlite3.Error as error:
        raise _refused(path, str(error)) from error


def _refused(path: Path, reason: str) -> BagError:
    return BagError(f"bag {path} is no SQLite bag of rosbag2, or is damaged: {reason}; copy it again from its source")
