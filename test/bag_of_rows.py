"""Bags of made-up numbers."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from straightcomp_ros.bags import PARAMETERS_ATTACHMENT
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import Stream


def bag_of_rows(path: Path, rows: Iterable[tuple[Stream, int, Sequence[float]]], parameters: str = "") -> Path:
    """A bag of messages, each a stream, its stamp in ns and its numbers; with the nodes' parameters in YAML or not."""
    with BagWriter(path) as bag:
        if parameters:
            bag.attach(PARAMETERS_ATTACHMENT, "application/yaml", parameters.encode())
        added: set[str] = set()
        for stream, stamp, numbers in rows:
            topic = f"/{stream.topic}"
            if topic not in added:
                bag.add(Topic(topic, stream.layout.type_name))
                added.add(topic)
            bag.write(topic, stream.layout.pack(stamp, *numbers), stamp, stamp)
    return path
