"""The nodes' diagnostics in a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from straightcomp_ros.bags.blocks import blocks
from straightcomp_ros.bags.definitions import typestore
from straightcomp_ros.bags.places import FRAME_SIZE, MESSAGE, rows
from straightcomp_ros.bags.reader import opened
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.timing.node_timing import Report

_TYPE = "diagnostic_msgs/msg/DiagnosticArray"


def read_reports(bag: Path) -> dict[str, list[Report]]:
    """What each node reported, by the node's name without its namespace, in the order of recording.

    Args:
        bag: rosbag2 folder, or one MCAP file. Without diagnostics in it the result is empty.

    Raises:
        BagError: the bag is absent or damaged, or several namespaces have diagnostics.
    """
    reports: dict[str, list[Report]] = {}
    with opened(bag) as files:
        for file in files:
            channels, _ = file.topics()
            topic = resolved(DIAGNOSTICS, {channel.topic for channel in channels.values()}, str(bag))
            wanted = {number for number, channel in channels.items() if channel.topic == topic}
            for block in blocks(file):
                for number in wanted & block.places.keys():
                    for start, head in zip(
                        block.places[number].tolist(), rows(block.data, block.places[number], MESSAGE), strict=True
                    ):
                        data = block.data[start + MESSAGE.itemsize : start + FRAME_SIZE + int(head["length"])]
                        try:
                            _add(reports, typestore().deserialize_cdr(data, _TYPE))
                        except (
                            Exception
                        ) as error:  # Whatever the decoder stumbles over in bytes that are no such message.
                            raise file.damaged(start, f"a message on '{topic}' does not decode ({error})") from error
    return reports


def _add(reports: dict[str, list[Report]], message: Any) -> None:
    time_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
    for status in message.status:
        values = {value.key: value.value for value in status.values}
        reports.setdefault(status.name.rsplit("/", 1)[-1], []).append(Report(time_ns, values))
