"""Reports to the graph that a client commissions the machine, and that the client is gone, however it ended.

The middleware itself reports that a publisher lives (liveliness): this costs the loop no message, and no process has to
be awake for it.
"""

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile

from straightcomp_ros.contract import COMMISSIONING_CLIENT

GONE_AFTER_S = 1.0
"""A process that was killed or suspended is taken for gone after this time."""
_BEGINS = "begins"
_LONGEST_TEXT = 500
_LIVELY = QoSProfile(
    depth=1,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=GONE_AFTER_S),
)


class CommissioningSign:
    """Says that a client commissions the machine, as long as its process lives and ``node`` exists."""

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(DiagnosticStatus, COMMISSIONING_CLIENT, _LIVELY)
        self._by = node.get_fully_qualified_name()
        self.report(_BEGINS)

    def report(self, doing: str) -> None:
        """Say what is done to the machine from now on."""
        self._publisher.publish(DiagnosticStatus(name=COMMISSIONING_CLIENT, message=doing, hardware_id=self._by))


class CommissioningWatch:
    """Knows what a client that commissions the machine of ``node``'s namespace does; calls ``gone`` when the last such
    client is gone."""

    def __init__(self, node: Node, gone: Callable[[], None] = lambda: None) -> None:
        self._gone, self._alive, self._reported = gone, 0, _BEGINS
        node.create_subscription(
            DiagnosticStatus,
            COMMISSIONING_CLIENT,
            self._on_report,
            _LIVELY,
            event_callbacks=SubscriptionEventCallbacks(liveliness=self._on_liveliness),
        )

    @property
    def doing(self) -> str:
        """What the client does; empty without one."""
        return self._reported if self._alive else ""

    def _on_report(self, message: DiagnosticStatus) -> None:
        self._reported = message.message[:_LONGEST_TEXT]

    def _on_liveliness(self, event: QoSLivelinessChangedInfo) -> None:
        before, self._alive = self._alive, event.alive_count
        if before and not self._alive:
            self._reported = _BEGINS
            self._gone()
