"""The nodes' diagnostics in a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.blocks import blocks
from straightcomp_ros.bags.definitions import typestore
from straightcomp_ros.bags.places import FRAME_SIZE, MESSAGE, rows
from straightcomp_ros.bags.reader import opened
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.timing.node_timing import Report, reporting_node

_TYPE = "diagnostic_msgs/msg/DiagnosticArray"


def read_reports(bag: Path) -> dict[str, list[Report]]:
    """What each node reported, by the node's name without its namespace, in the order of recording.

    Nodes of all namespaces report on one topic: those in the namespace of the bag's encoder are taken.

    Args:
        bag: rosbag2 folder, or one MCAP file. Without diagnostics in it the result is empty.

    Raises:
        BagError: the bag is absent or damaged, or has several encoders, or none and several namespaces.
    """
    reports: dict[str, list[Report]] = {}
    with opened(bag) as files:
        topics = [file.topics()[0] for file in files]
        names = {channel.topic for channels in topics for channel in channels.values()}
        encoder = resolved(ENCODER.topic, names, str(bag))
        # Bags of 0.1 have it in the nodes' namespace.
        topic = resolved(DIAGNOSTICS.lstrip("/"), names, str(bag))
        for file, channels in zip(files, topics, strict=True):
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
    namespaces = {(encoder or name).rpartition("/")[0].strip("/") for name in reports}
    if len(namespaces) > 1:
        raise BagError(f"bag {bag}: nodes of several namespaces report: {', '.join(sorted(reports))}")
    namespace = next(iter(namespaces), "")
    return {node: found for name, found in reports.items() if (node := reporting_node(name, namespace))}


def _add(reports: dict[str, list[Report]], message: Any) -> None:
    time_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
    for status in message.status:
        values = {value.key: value.value for value in status.values}
        reports.setdefault(status.name, []).append(Report(time_ns, values))
