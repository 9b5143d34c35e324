"""Asks the driver to switch the amplifier off."""

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.contract import TRIP
from straightcomp_ros.safety.faults import Fault


def tripper(node: Node) -> Callable[[Fault, str], None]:
    """A function ``trip(fault, reason)``."""
    publisher = node.create_publisher(DiagnosticStatus, TRIP, 10)
    source = node.get_fully_qualified_name()

    def trip(fault: Fault, reason: str) -> None:
        publisher.publish(
            DiagnosticStatus(level=DiagnosticStatus.ERROR, name=fault.label, message=reason, hardware_id=source)
        )

    return trip
