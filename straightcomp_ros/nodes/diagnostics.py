"""Publishes a node's counters and timing at 1 Hz as diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from straightcomp_ros.contract import DIAGNOSTICS, PACKAGE
from straightcomp_ros.timing.report import RATE, SAMPLES


class Diagnostics:
    """Asks for the values once a second and publishes them, with the rate at which ``samples`` grow.

    Args:
        node: the node that reports.
        values: called at 1 Hz; names and values, with the key ``samples``, and the key ``error`` where something is
            wrong, which sets the level.
    """

    def __init__(self, node: Node, values: Callable[[], Mapping[str, object]]) -> None:
        self._node = node
        self._values = values
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        self._before = (time.monotonic(), 0)
        node.create_timer(1.0, self._publish)

    def _publish(self) -> None:
        values = dict(self._values())
        values[RATE] = self._rate(values[SAMPLES])
        error = str(values.get("error", ""))
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if error else DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=error or "running",
            hardware_id=PACKAGE,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _rate(self, samples: int) -> str:
        now = time.monotonic()
        before, samples_before = self._before
        self._before = (now, samples)
        return f"{(samples - samples_before) / (now - before):.1f}"
