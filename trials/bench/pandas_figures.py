"""What many write in their first hour: a bag read by rosbags, joined by pandas, one figure of each stroke."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from straightcomp_ros.bags.topics import typestore
from straightcomp_ros.contract import COMMAND, ENCODER, REFERENCE
from straightcomp_ros.messages.cdr import NANOSECONDS

_TOPICS = {f"/{stream.topic}" for stream in (ENCODER, REFERENCE, COMMAND)}


def errors_pp(bag: Path, strokes: list[tuple[int, int]]) -> list[float]:
    """Error r − y, p-p in m, of each stroke of a bag; a stroke is its first and last stamp in ns. ImportError where
    pandas is not installed."""
    import pandas
    from rosbags.rosbag2 import Reader

    store = typestore()
    rows: dict[str, list[tuple[Any, ...]]] = {topic: [] for topic in _TOPICS}
    with Reader(bag) as reader:
        chosen = [connection for connection in reader.connections if connection.topic in _TOPICS]
        for connection, _, data in reader.messages(chosen):
            message: Any = store.deserialize_cdr(data, connection.msgtype)
            stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
            rows[connection.topic].append((stamp, *_numbers(connection.topic, message)))
    encoder = pandas.DataFrame(rows[f"/{ENCODER.topic}"], columns=["stamp", "x", "y"])
    reference = pandas.DataFrame(rows[f"/{REFERENCE.topic}"], columns=["stamp", "r"])
    command = pandas.DataFrame(rows[f"/{COMMAND.topic}"], columns=["stamp", "current"])
    joined = encoder.merge(reference, on="stamp").merge(command, on="stamp").set_index("stamp")
    error = joined["r"] - joined["y"]
    return [float(error.loc[begin:end].max() - error.loc[begin:end].min()) for begin, end in strokes]


def _numbers(topic: str, message: Any) -> tuple[float, ...]:
    if topic == f"/{ENCODER.topic}":
        return tuple(message.position)
    return (message.points[0].positions[0],) if topic == f"/{REFERENCE.topic}" else (message.effort[0],)
