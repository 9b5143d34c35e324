"""The driver's services and topics for its safety state machine, for operators and cell controllers; and the sign of a
client that commissions the machine.

The middleware itself reports that the client's publisher lives (liveliness): this costs the loop no message, and no
process has to be awake for it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.contract import COMMISSIONING_CLIENT, SAFETY_STATE, TRIP
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.runtime.guarded_node import Refused, ThrottledWarning
from straightcomp_ros.runtime.loops import now_ns
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.safety.faults import LABELLED, Fault, one_line
from straightcomp_ros.safety.state_machine import Latched, SafetyMachine
from straightcomp_ros.timing.node_timing import count

GONE_AFTER_S = 1.0
"""A process that was killed or suspended is taken for gone after this time."""
_BEGINS = "begins"
_LIVELY = QoSProfile(
    depth=1,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=GONE_AFTER_S),
)


def commissioning_sign(node: Node) -> Callable[[str], None]:
    """A function that says what is done to the machine from now on. A client commissions it as long as its process
    lives and ``node`` exists."""
    publisher = node.create_publisher(DiagnosticStatus, COMMISSIONING_CLIENT, _LIVELY)
    by = node.get_fully_qualified_name()

    def report(doing: str) -> None:
        publisher.publish(DiagnosticStatus(name=COMMISSIONING_CLIENT, message=doing, hardware_id=by))

    report(_BEGINS)
    return report


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
        self._reported = one_line(message.message)

    def _on_liveliness(self, event: QoSLivelinessChangedInfo) -> None:
        before, self._alive = self._alive, event.alive_count
        if before and not self._alive:
            self._reported = _BEGINS
            self._gone()


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""A late subscriber gets the last message too."""
_CONDITION, _CODE = "condition", "code"


class SafetyState(NamedTuple):
    """Content of a message on `safety_state`.

    Attributes:
        condition: of the driver's safety state machine.
        fault: name and reason of the fault; empty without one.
        code: number of the fault; 0 without one.
    """

    condition: State = State.OFF
    fault: str = ""
    code: int = 0

    @classmethod
    def of(cls, message: DiagnosticStatus) -> SafetyState:
        """Read a message. One without a known condition counts as a fault."""
        values = {value.key: value.value for value in message.values}
        condition = {known.value: known for known in State}.get(values.get(_CONDITION, ""), State.FAULT)
        fault = one_line(f"{message.name}: {message.message}") if message.name else ""
        return cls(condition, fault, count(values, _CODE))

    @property
    def amplifier_on(self) -> bool:
        """Whether the amplifier is on."""
        return self.condition is State.ON


def safety_status(condition: State, fault: Latched | None, hardware_id: str) -> DiagnosticStatus:
    """A message for `safety_state`."""
    values = {
        _CONDITION: condition.value,
        _CODE: str(fault.fault.code if fault else 0),
        "time_ns": str(fault.time_ns if fault else now_ns()),
    }
    return DiagnosticStatus(
        level=DiagnosticStatus.ERROR if fault else DiagnosticStatus.OK,
        name=fault.fault.label if fault else "",
        message=fault.reason if fault else f"amplifier {condition.value}",
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


class SafetyPanel:
    """The driver's services ``~/enable`` and ``~/reset_fault``, and its topic `safety_state`.

    It switches off on requests on `trip`, and when a client that commissions the machine leaves the amplifier on.
    ``refusal`` returns why the amplifier may not be switched on now, apart from faults; empty if it may. ``anew`` is
    called after the amplifier was switched on or off, and before a fault is cleared: what came before counts no more.
    Unless x is ``referenced`` it means nothing that x is beyond the map.
    """

    def __init__(
        self,
        node: ManagedNode,
        safety: SafetyMachine,
        refusal: Callable[[], str],
        anew: Callable[[], None],
        referenced: Callable[[], bool],
    ) -> None:
        self._node, self._safety = node, safety
        self._refusal, self._anew, self._referenced = refusal, anew, referenced
        self._publisher = node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
        self._reported: tuple[State, str] | None = None
        node.offer(SetBool, "~/enable", self._on_enable)
        node.offer(Trigger, "~/reset_fault", self._on_reset_fault)
        node.create_subscription(DiagnosticStatus, TRIP, self._on_trip, 10)
        self._client = CommissioningWatch(node, self._on_client_gone)
        self._on_for_client = False
        self._refused = ThrottledWarning(node, "enable is refused")
        self.report()

    def report(self) -> None:
        """Publish the state and log a fault, if they have changed since the last report."""
        fault, condition = self._safety.fault, self._safety.condition
        now = (condition, self._safety.reason)
        if now == self._reported:
            return
        self._reported = now
        self._publisher.publish(safety_status(condition, fault, self._node.get_fully_qualified_name()))
        if fault:
            self._node.get_logger().error(f"fault, amplifier off: {self._safety.reason}")

    def _on_enable(self, on: bool) -> str:
        """Switch the amplifier on (refused while a fault is latched or fresh commands are missing), or off."""
        before, message = self._safety.condition, f"amplifier {'on' if on else 'off'}"
        if not on:
            self._safety.disable()
        elif refusal := ("" if self._safety.fault else self._refusal()) or self._safety.enable():
            self._refused.log(refusal)
            raise Refused(refusal)
        else:
            self._on_for_client = bool(self._client.doing)
        if self._safety.condition is not before:
            self._anew()
            self._node.get_logger().info(f"enable: {message}")
            self.report()
        return message

    def _on_reset_fault(self) -> str:
        """Clear the latched fault; the amplifier stays off."""
        reason = self._safety.reason
        if reason:
            self._anew()
        self._safety.reset()
        self.report()
        return f"cleared: {reason}" if reason else "there was no fault"

    def _on_client_gone(self) -> None:
        # A client that was refused since another client uses the machine leaves it as it is.
        if self._safety.condition is State.ON and self._on_for_client:
            self._safety.trip(Fault.CLIENT_GONE, "the client that commissioned the machine is gone", now_ns())
            self.report()

    def _on_trip(self, message: DiagnosticStatus) -> None:
        # While the driver is not active the amplifier is off anyway: do not latch a fault that must then be reset.
        if self._node.active:
            fault = LABELLED.get(message.name, Fault.TRIPPED)
            if fault is Fault.MAP_MISSING and not self._referenced():
                return
            self._safety.trip(fault, one_line(message.message) or "no reason given", now_ns())
            self.report()


def tripper(node: Node) -> Callable[[Fault, str], None]:
    """A function ``trip(fault, reason)`` that asks the driver to switch the amplifier off."""
    publisher = node.create_publisher(DiagnosticStatus, TRIP, 10)
    source = node.get_fully_qualified_name()

    def trip(fault: Fault, reason: str) -> None:
        publisher.publish(
            DiagnosticStatus(level=DiagnosticStatus.ERROR, name=fault.label, message=reason, hardware_id=source)
        )

    return trip
