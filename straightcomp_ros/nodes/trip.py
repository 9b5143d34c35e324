"""Asks the driver to switch the amplifier off."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.contract import TRIP


def tripper(node: Node) -> Callable[[str, str], None]:
    """A function ``trip(name of the fault, reason)``."""
    publisher = node.create_publisher(DiagnosticStatus, TRIP, 10)
    source = node.get_fully_qualified_name()

    def trip(name: str, reason: str) -> None:
        publisher.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, name=name, message=reason, hardware_id=source))

    return trip
