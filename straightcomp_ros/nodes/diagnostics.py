"""Publishes a node's counters and timing at 1 Hz as diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.timing.level import Levels
from straightcomp_ros.timing.report import LOST, OVERRUNS, RATE, SAMPLES

_LATER_S = 0.02
"""A few turns of a loop's idle work."""


class Diagnostics:
    """Asks for the values once a second and publishes them, with the rate at which ``samples`` grow.

    Both take some 0.2 ms, as caches are cold: in one turn of a loop's idle work they would make the next cycle late.

    Args:
        node: the node that reports.
        values: called at 1 Hz; names and values, with the key ``samples``, and the key ``error`` where something is
            wrong, which sets the level. A name ends with its unit, where it is no plain count: ``_us``, ``_hz``.
        hardware_id: of what the node reports on; this computer's name if empty.
    """

    def __init__(self, node: Node, values: Callable[[], Mapping[str, object]], hardware_id: str = "") -> None:
        self._hardware_id = hardware_id or platform.node()
        self._levels = Levels()
        self._node = node
        self._values = values
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        self._before = (time.monotonic(), 0)
        self._collected: Mapping[str, object] = {}
        self._stamp = node.get_clock().now()
        node.create_timer(1.0, self._collect)
        self._later = node.create_timer(_LATER_S, self._publish)
        self._later.cancel()

    def _collect(self) -> None:
        values = self._values()
        self._collected = {**values, RATE: self._rate(int(str(values[SAMPLES])))}
        self._stamp = self._node.get_clock().now()
        self._later.reset()

    def _publish(self) -> None:
        self._later.cancel()
        values = self._collected
        error = str(values.get("error", ""))
        lost, overruns = (int(str(values.get(name, 0))) for name in (LOST, OVERRUNS))
        level, words = self._levels.next(int(str(values[SAMPLES])), lost, overruns, bool(error))
        status = DiagnosticStatus(
            level=bytes([level]),
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=error or words,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._stamp.to_msg()
        self._publisher.publish(message)

    def _rate(self, samples: int) -> str:
        now = time.monotonic()
        before, samples_before = self._before
        self._before = (now, samples)
        return f"{(samples - samples_before) / (now - before):.1f}"
