"""The nodes' diagnostics in a bag."""

from __future__ import annotations

from pathlib import Path

from straightcomp_ros.bags.folder import opened, topic_names
from straightcomp_ros.bags.messages import decoded, messages_on
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.timing.node_timing import Report


def read_reports(bag: Path) -> dict[str, list[Report]]:
    """What each node reported, by the node's name without its namespace, in the order of recording; empty for a bag
    without diagnostics. Raises BagError when the bag is absent or damaged, or several namespaces have diagnostics."""
    reports: dict[str, list[Report]] = {}
    with opened(bag) as files:
        topic = resolved(DIAGNOSTICS, topic_names(files), str(bag))
        messages = messages_on(topic, files).data if topic else []
    for number, data in enumerate(messages):
        where = f"bag {bag}: topic '{topic}', message {number}"
        message = decoded(where, data, "diagnostic_msgs/msg/DiagnosticArray")
        time_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            reports.setdefault(status.name.rsplit("/", 1)[-1], []).append(Report(time_ns, values))
    return reports
