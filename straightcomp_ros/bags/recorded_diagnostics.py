"""The nodes' diagnostics in a bag."""

import warnings
from pathlib import Path

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.folder import opened, topic_names
from straightcomp_ros.bags.messages import Messages, decoded, messages_on
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.timing.node_timing import Report, reporting_node


def read_reports(bag: Path) -> dict[str, list[Report]]:
    """What each node reported, by the node's name without its namespace, in the order of recording; empty for a bag
    without diagnostics.

    Nodes of all namespaces report on one topic: those in the namespace of the bag's encoder are taken.

    Raises:
        BagError: the bag is absent or damaged, or has several encoders, or none and several namespaces.
    """
    with opened(bag) as files:
        names = topic_names(files)
        encoder = resolved(ENCODER.topic, names, str(bag))
        # Bags of 0.1 have it in the nodes' namespace.
        topic = resolved(DIAGNOSTICS.lstrip("/"), names, str(bag))
        messages = messages_on(topic, files) if topic else Messages(DIAGNOSTICS)
    return reports_in(bag, messages, encoder)


def reports_in(bag: Path, messages: Messages, encoder: str | None) -> dict[str, list[Report]]:
    """What :func:`read_reports` returns, from the ``messages`` of the diagnostics' topic of a bag; ``encoder`` is the
    full name of its encoder's topic. BagError as there."""
    reports: dict[str, list[Report]] = {}
    for number, data in enumerate(messages.data):
        where = f"bag {bag}: topic '{messages.topic}', message {number}"
        try:
            message = decoded(where, data, "diagnostic_msgs/msg/DiagnosticArray")
        except BagError as error:
            # Any program on the machine may publish here.
            warnings.warn(f"{error}; it is left out", stacklevel=2)
            continue
        time_ns = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            reports.setdefault(status.name, []).append(Report(time_ns, values, status.hardware_id))
    namespaces = {(encoder or name).rpartition("/")[0].strip("/") for name in reports}
    if len(namespaces) > 1:
        raise BagError(f"bag {bag}: nodes of several namespaces report: {', '.join(sorted(reports))}")
    namespace = next(iter(namespaces), "")
    return {node: found for name, found in reports.items() if (node := reporting_node(name, namespace))}
