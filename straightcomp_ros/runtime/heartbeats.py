"""Tells from heartbeats which nodes are alive, and in which lifecycle state."""

import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.contract import HEARTBEAT

_TICK_S = 0.05


class Heartbeats:
    """Listens to nodes. A node is silent until its first heartbeat, and again ``timeout`` s after its last one."""

    def __init__(self, node: Node, names: Sequence[str], timeout: float = 1.0) -> None:
        self._timeout = timeout
        self._ages = dict.fromkeys(names, timeout)
        self.states = dict.fromkeys(names, "")
        """Lifecycle state of each node by its last heartbeat; empty before the first."""
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
