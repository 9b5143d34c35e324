"""Watches the graph without touching its loop: streams from inboxes, diagnostics, and what both say together."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.cell.observation import ABSENT, SILENT, Observation
from straightcomp_ros.cell.stroke_errors import StrokeErrors
from straightcomp_ros.contract import (
    ALWAYS_PUBLISHED,
    CONTROLLER_STATE,
    DIAGNOSTICS,
    DRIVER_STATE,
    POSITION,
    SAFETY_STATE,
    UNCONNECTED,
)
from straightcomp_ros.runtime.batch_streams import BurstQueue
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.runtime.streams import Inbox, unspun_node
from straightcomp_ros.timing.node_timing import LOST, SAMPLES, reporting_node

_FRESH_S = 0.5
_REPORT_LASTS_S = 5.0
_YIELD_EVERY = 64
_DRIVER = "driver"
_ERROR = CONTROLLER_STATE.layout.columns.index("error")
_SIGMA = CONTROLLER_STATE.layout.columns.index("sliding_variable")
Messages = list[tuple[int, list[float], int]]
"""As :meth:`Inbox.fetch` gives them."""


class Fetched(NamedTuple):
    """What has come since the last look."""

    positions: Messages
    controller: Messages
    driver: Messages


class GraphWatch:
    """Reads bursts, and what comes seldom: its reading costs the loops that publish next to nothing.

    Args:
        node: watches; must be spun for the diagnostics and the safety state.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        unspun = unspun_node(node)
        self._position = Inbox(node, unspun, POSITION)
        self._controller = Inbox(node, unspun, CONTROLLER_STATE, BurstQueue(node, unspun, CONTROLLER_STATE))
        self._driver = Inbox(node, unspun, DRIVER_STATE, BurstQueue(node, unspun, DRIVER_STATE))
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, 10)
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        self._safety = SafetyState()
        self._strokes = StrokeErrors()
        self._last_ns, self._last_came = 0, -math.inf
        self._x = self._y = self._error = self._sigma = math.nan
        self._reports: dict[str, tuple[float, dict[str, str]]] = {}
        self._errors: dict[str, str] = {}

    def fetch(self) -> Fetched:
        """Take what has come; call it some ten times a second or more."""
        fetched = Fetched(self._position.fetch(), self._controller.fetch(), self._driver.fetch())
        for number, (stamp_ns, (x, y), _) in enumerate(fetched.positions):
            self._strokes.add_position(stamp_ns, x)
            self._x, self._y = x, y
            if number % _YIELD_EVERY == 0:
                # With real-time scheduling nodes of the same priority would have to wait for the end of this.
                os.sched_yield()
        for number, (_, numbers, _) in enumerate(fetched.controller):
            self._strokes.add_error(numbers[_ERROR])
            if number % _YIELD_EVERY == 0:
                os.sched_yield()
        if fetched.controller:
            self._error, self._sigma = fetched.controller[-1][1][_ERROR], fetched.controller[-1][1][_SIGMA]
        if fetched.driver:
            self._last_ns, self._last_came = fetched.driver[-1][0], time.monotonic()
        return fetched

    def reports(self) -> dict[str, dict[str, str]]:
        """By node, the values of its newest diagnostics; without those that have fallen silent."""
        oldest = time.monotonic() - _REPORT_LASTS_S
        return {node: values for node, (came, values) in self._reports.items() if came > oldest}

    def observation(self, states: Mapping[str, str]) -> Observation:
        """The graph now; ``states`` are those of its nodes."""
        fresh = time.monotonic() - self._last_came < _FRESH_S
        reports = self.reports()
        controller = reports.get("controller", {})
        return Observation(
            nodes=dict(states),
            faults=self._faults(states, reports),
            fault_code=self._safety.code if self._driver_speaks(states) else 0,
            unrecorded=self._unrecorded(states, reports),
            fresh=fresh,
            amplifier_on=fresh and self._safety.amplifier_on,
            stamp_ns=self._last_ns,
            x=self._x,
            y=self._y,
            still=self._strokes.still,
            error=self._error,
            sliding_variable=self._sigma,
            stroke_error_pp=self._strokes.last_pp,
            samples=int(controller.get(SAMPLES, 0)),
            lost_samples=int(controller.get(LOST, 0)),
        )

    def _faults(self, states: Mapping[str, str], reports: Mapping[str, object]) -> dict[str, str]:
        """By node. The driver's are in its safety state at once, a second before they are in its diagnostics."""
        faults = {node: text for node, text in self._errors.items() if node in reports and node != _DRIVER}
        if self._safety.fault and self._driver_speaks(states):
            faults[_DRIVER] = self._safety.fault
        return faults

    @staticmethod
    def _driver_speaks(states: Mapping[str, str]) -> bool:
        return states.get(_DRIVER) not in (ABSENT, SILENT)

    def _unrecorded(self, states: Mapping[str, str], reports: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
        if "logger" not in states:
            return ()
        unconnected = reports.get("logger", {}).get(UNCONNECTED)
        if unconnected is None:
            return ("all topics",)
        wanted = {self._node.resolve_topic_name(stream.topic) for stream in ALWAYS_PUBLISHED}
        return tuple(sorted(wanted.intersection(unconnected.split())))

    def _on_safety_state(self, message: DiagnosticStatus) -> None:
        self._safety = SafetyState.of(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = reporting_node(status.name, self._node.get_namespace())
            if not name:
                continue
            self._reports[name] = (time.monotonic(), {value.key: value.value for value in status.values})
            if status.level == DiagnosticStatus.ERROR:
                self._errors[name] = status.message
            else:
                self._errors.pop(name, None)
