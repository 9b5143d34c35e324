"""Bags that rosbag2 stored as SQLite, as messages in MCAP's own framing: one decoder then serves both.

Source: rosbag2_storage_sqlite3, tables `topics` (id, name, type, serialization_format, …) and `messages` (topic_id,
timestamp in ns, data). It stores the time of reception only, which stands for the publish time too.
"""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.mcap_records import MESSAGE, MESSAGE_FIELDS, Block
from straightcomp_ros.bags.topics import RecordedTopic

_AT_ONCE = 5000


class SqliteInput:
    """A SQLite file of a bag, read as :class:`straightcomp_ros.bags.mcap_input.McapInput` reads MCAP. Every method
    raises BagError when the file is no bag, or is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def topics(self) -> dict[int, RecordedTopic]:
        """Topics by id; their definitions where the file has them, which is since ROS 2 Iron."""
        found = list(self._query("SELECT id, name, type, serialization_format FROM topics"))
        definitions = {}
        if any(self._query("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'")):
            described = self._query("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
            definitions = {type_name: (text, encoding) for type_name, text, encoding in described if text}
        return {
            topic_id: RecordedTopic(name, type_name, encoding, *definitions.get(type_name, ()))
            for topic_id, name, type_name, encoding in found
        }

    def blocks(self, wanted: Collection[str]) -> Iterator[Block]:
        """Messages of the topics with these names, topic by topic in the order in which they were recorded."""
        for name in wanted:
            ids = [topic_id for topic_id, topic in self.topics.items() if topic.name == name]
            places = ", ".join("?" * len(ids))
            statement = f"SELECT timestamp, data FROM messages WHERE topic_id IN ({places}) ORDER BY timestamp, id"
            found = self._query(statement, *ids)
            while records := [self._record(*row) for row in islice(found, _AT_ONCE)]:
                sizes = np.array([len(record) for record in records], np.int64)
                yield Block(b"".join(records), {name: np.cumsum(sizes) - sizes})

    def _record(self, time_ns: object, data: object) -> bytes:
        if not isinstance(data, bytes) or not isinstance(time_ns, int) or time_ns < 0:
            raise self._refused("a message has no data, or no time")
        return MESSAGE.pack(Opcode.MESSAGE, MESSAGE_FIELDS + len(data), 0, 0, time_ns, time_ns) + data

    def _query(self, statement: str, *values: int) -> Iterator[tuple[Any, ...]]:
        try:
            # Read only: SQLite must not create files beside the bag.
            with closing(sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro", uri=True)) as connection:
                yield from connection.execute(statement, values)
        except sqlite3.Error as error:
            raise self._refused(str(error)) from error

    def _refused(self, reason: str) -> BagError:
        advice = "copy it again from its source"
        return BagError(f"bag {self.path} is no SQLite bag of rosbag2, or is damaged: {reason}; {advice}")
