"""Observes the graph without loading its loop: heartbeats, streams, diagnostics, and all in one observation."""

import math
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.cell.observation import ABSENT, SILENT, Observation, StrokeErrors
from straightcomp_ros.contract import (
    ALWAYS_PUBLISHED,
    CONTROLLER_STATE,
    DIAGNOSTICS,
    DRIVER_STATE,
    HEARTBEAT,
    POSITION,
    SAFETY_STATE,
    UNCONNECTED,
)
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.runtime.safety_panel import LATCHED, LONGEST_REASON, SafetyState
from straightcomp_ros.runtime.streams import Streams
from straightcomp_ros.timing.node_timing import DESCRIPTION, EXCITATION, EXCITING, LOST, SAMPLES, count, reporting_node

_TICK_S = 0.05
_REPORT_LASTS_S = 5.0
_YIELD_EVERY = 64
_DRIVER = "driver"
_ERROR = CONTROLLER_STATE.layout.columns.index("error")
_SIGMA = CONTROLLER_STATE.layout.columns.index("sliding_variable")
Messages = Sequence[tuple[int, Sequence[float], int]]
"""As :meth:`SubscriptionQueue.fetch` returns them."""


class Heartbeats:
    """Which nodes are alive. A node is silent until its first heartbeat, and again ``timeout`` s after its last one.

    Attributes:
        states: lifecycle state of each node by its last heartbeat; empty before the first.
    """

    def __init__(self, node: Node, names: Sequence[str], timeout: float = 1.0) -> None:
        self._timeout = timeout
        self._ages = dict.fromkeys(names, timeout)
        self.states = dict.fromkeys(names, "")
        self._ticked = time.monotonic()
        node.create_subscription(DiagnosticStatus, HEARTBEAT, self._on_heartbeat, 100)
        node.create_timer(_TICK_S, self._tick)

    def silent(self, seconds: float | None = None) -> list[str]:
        """Nodes without a heartbeat within the timeout, or within ``seconds``."""
        limit = self._timeout if seconds is None else seconds
        return [name for name, age in self._ages.items() if age >= limit]

    def forget(self, name: str) -> None:
        """Count a node that is started again as silent until its next heartbeat."""
        self._ages[name] = self._timeout

    def in_state(self, state: str) -> bool:
        """Whether all nodes are alive and in this lifecycle state."""
        return not self.silent() and set(self.states.values()) == {state}

    def _tick(self) -> None:
        # A process that was suspended must not mistake its own pause for silence of the nodes.
        now = time.monotonic()
        passed, self._ticked = min(now - self._ticked, 2.0 * _TICK_S), now
        for name in self._ages:
            self._ages[name] += passed

    def _on_heartbeat(self, message: DiagnosticStatus) -> None:
        if message.name in self._ages:
            self._ages[message.name] = 0.0
            self.states[message.name] = message.message


class FetchedMessages(NamedTuple):
    """Messages since the last call."""

    positions: Messages
    controller: Messages = ()
    driver: Messages = ()


class GraphWatch:
    """Reads batches and slow topics only, which costs the publishing loops almost nothing.

    Args:
        node: subscribes; an executor must spin it for the diagnostics and the safety state.
        batches: also read `controller_state` and `driver_state`; otherwise errors and σ stay unknown.
        fresh: time after the last sample for which the observation is fresh, s.
        patient: the observation is also fresh before the first sample, until :meth:`expect_samples` is called.
        description: of the stage, by which ``node`` itself moves it; empty if it does not.

    Attributes:
        safety: the driver's newest safety state.
    """

    def __init__(
        self,
        node: Node,
        *,
        batches: bool = True,
        fresh: float = 0.5,
        patient: bool = False,
        description: str = "",
    ) -> None:
        self._node, self._fresh = node, fresh
        self._own = {node.get_name(): description} if description else {}
        self.streams = Streams(node)
        self._queues = [self.streams.queue(POSITION)]
        if batches:
            self._queues += [self.streams.batches(stream) for stream in (CONTROLLER_STATE, DRIVER_STATE)]
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 10)
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        self.safety = SafetyState()
        self._strokes = StrokeErrors()
        self._newest = Observation()
        self._last_came = math.inf if patient else -math.inf
        self._reports: dict[str, tuple[float, dict[str, str]]] = {}
        self._errors: dict[str, str] = {}

    def expect_samples(self) -> None:
        """Count the absence of a first sample as silence from now on."""
        self._last_came = min(self._last_came, time.monotonic())

    def fetch(self) -> FetchedMessages:
        """Take the messages that have arrived; call it at least ten times a second."""
        fetched = FetchedMessages(*(queue.fetch() for queue in self._queues))
        for number, (stamp_ns, (x, y), _) in enumerate(fetched.positions, 1):
            self._strokes.add_position(stamp_ns, x)
            if number % _YIELD_EVERY == 0 or number == len(fetched.positions):
                # Nodes of the same real-time priority would otherwise wait until this loop ends.
                os.sched_yield()
                self._newest = replace(self._newest, x=x, y=y)
        for number, (_, numbers, _) in enumerate(fetched.controller, 1):
            self._strokes.add_error(numbers[_ERROR])
            if number % _YIELD_EVERY == 0 or number == len(fetched.controller):
                os.sched_yield()
                self._newest = replace(self._newest, error=numbers[_ERROR], sliding_variable=numbers[_SIGMA])
        for messages in (fetched.driver, fetched.positions):
            if messages:
                first_ns = self._newest.first_ns or messages[0][0]
                self._newest = replace(self._newest, stamp_ns=messages[-1][0], first_ns=first_ns)
                self._last_came = time.monotonic()
        return fetched

    def reports(self) -> dict[str, dict[str, str]]:
        """Values of each node's newest diagnostics, without the nodes that have fallen silent."""
        oldest = time.monotonic() - _REPORT_LASTS_S
        return {node: values for node, (came, values) in self._reports.items() if came > oldest}

    def observation(self, states: Mapping[str, str], commissioning: str = "") -> Observation:
        """The graph now, given the ``states`` of its nodes and what a client that commissions it is doing."""
        fresh = time.monotonic() - self._last_came < self._fresh
        reports = self.reports()
        controller = reports.get("controller", {})
        # A fault of the driver is in its safety state at once, but in its diagnostics up to a second later.
        safety = self.safety if states.get(_DRIVER) not in (ABSENT, SILENT) else SafetyState()
        faults = {node: text for node, text in self._errors.items() if node in reports and node != _DRIVER}
        reported = {node: values[DESCRIPTION] for node, values in reports.items() if DESCRIPTION in values}
        return replace(
            self._newest,
            nodes=dict(states),
            faults=faults | ({_DRIVER: safety.fault} if safety.fault else {}),
            fault_code=safety.code,
            unrecorded=self._unrecorded(reports) if "logger" in states else (),
            descriptions=self._own | reported,
            fresh=fresh,
            commissioning=commissioning or ("excitation" if controller.get(EXCITATION) == EXCITING else ""),
            amplifier_on=fresh and self.safety.amplifier_on,
            still=self._strokes.still,
            stroke_error_pp=self._strokes.last_pp,
            samples=count(controller, SAMPLES),
            lost_samples=count(controller, LOST),
        )

    def _unrecorded(self, reports: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
        unconnected = reports.get("logger", {}).get(UNCONNECTED)
        if unconnected is None:
            return ("all topics",)
        wanted = {self._node.resolve_topic_name(stream.topic) for stream in ALWAYS_PUBLISHED}
        return tuple(sorted(wanted.intersection(unconnected.split())))

    def _on_safety_state(self, message: DiagnosticStatus) -> None:
        self.safety = SafetyState.of(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = reporting_node(status.name, self._node.get_namespace())
            # Each name stays in memory, and any program may publish here.
            if name not in NODE_PARAMETERS:
                continue
            self._reports[name] = (time.monotonic(), {value.key: value.value for value in status.values})
            self._errors.pop(name, None)
            if status.level == DiagnosticStatus.ERROR:
                self._errors[name] = status.message[:LONGEST_REASON]
