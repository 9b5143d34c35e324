"""The serialised messages of one topic of a bag, of whatever type."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.definitions import typestore
from straightcomp_ros.bags.folder import BagInput, compressed_messages, opened, topic_names
from straightcomp_ros.bags.mcap_records import FRAME, HEAD, rows
from straightcomp_ros.bags.topics import RecordedTopic, resolved

COMPRESSIONS = {b"\x28\xb5\x2f\xfd": "zstd", b"\x04\x22\x4d\x18": "lz4"}
"""Compressions by the first bytes of what they make; no message in CDR begins so."""


@dataclass
class Messages:
    """Messages of one topic in the order in which they were recorded.

    Attributes:
        topic, type_name, definition, definition_encoding: as in :class:`straightcomp_ros.bags.topics.RecordedTopic`.
        log_time, publish_time: when each was received, and made by its source, ns since the epoch.
        data: each as CDR.
    """

    topic: str
    type_name: str = ""
    definition: str = ""
    definition_encoding: str = ""
    log_time: list[int] = field(default_factory=list)
    publish_time: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)

    def describe(self, topic: RecordedTopic) -> None:
        """Take type and definition of the first entry that has them."""
        self.type_name = self.type_name or topic.type_name
        if topic.definition and not self.definition:
            self.definition, self.definition_encoding = topic.definition, topic.definition_encoding

    def add(self, block: bytes, starts: NDArray[np.int64]) -> None:
        """Take the message records at ``starts`` (n,) in ``block``."""
        heads = rows(block, starts, HEAD)
        self.log_time += heads["log_time"].tolist()
        self.publish_time += heads["publish_time"].tolist()
        ends = starts + FRAME.size + heads["length"].astype(np.int64)
        data = zip((starts + HEAD.itemsize).tolist(), ends.tolist(), strict=True)
        self.data += [block[first:end] for first, end in data]


def read_messages(bag: Path, topic: str) -> Messages:
    """All messages of ``topic``, named as :func:`straightcomp_ros.bags.topics.resolved` takes it.

    Raises BagError when the bag cannot be read, is damaged, lacks the topic, or has no messages on it. Warns
    (UserWarning) when the bag was not finished.
    """
    with opened(bag) as files:
        names = topic_names(files)
        full = resolved(topic, names, str(bag))
        if full is None:
            raise BagError(f"bag {bag}: has no topic '{topic}'; it has {', '.join(sorted(names))}")
        found = messages_on(full, files)
    if not found.data:
        raise BagError(f"bag {bag}: topic '{full}' has no messages; was its publisher running?")
    return found


def messages_on(topic: str, files: Sequence[BagInput]) -> Messages:
    """All messages of the topic with this full name. Raises BagError when the bag is damaged."""
    found = Messages(topic)
    for file in files:
        ours = [entry for entry in file.topics.values() if entry.name == topic]
        for entry in ours:
            if found.type_name not in ("", entry.type_name):
                kinds = f"'{found.type_name}' and '{entry.type_name}'"
                raise BagError(f"bag {file.path}: topic '{topic}' has messages of types {kinds}; allowed is one type")
            found.describe(entry)
        for block, places in file.blocks([topic]) if ours else ():
            if topic in places:
                found.add(block, places[topic])
    return found


def decoded(where: str, data: bytes, type_name: str) -> Any:
    """The message in ``data``, decoded by rosbags. Raises BagError when the bytes are no such message; the text begins
    with ``where``."""
    if compression := COMPRESSIONS.get(data[:4]):
        raise BagError(f"{where}: {compressed_messages(compression)}")
    try:
        return typestore().deserialize_cdr(data, type_name)
    except Exception as error:  # The decoder raises errors of many kinds on malformed bytes.
        raise BagError(f"{where} does not decode ({error}); allowed is a {type_name}") from error
