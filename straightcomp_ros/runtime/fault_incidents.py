"""Packs an incident (`straightcomp incident`) at each latched fault, in a process that gets idle time only."""

import subprocess
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.contract import SAFETY_STATE
from straightcomp_ros.runtime.safety_panel import LATCHED

LAST_S = 60
"""Time in s before the fault that an incident has: some 30 MB at 2 kHz, which bounds its size."""
_AFTER_S = 2.0
"""Wait in s after the fault, in which each node reports it once and the bag has what follows it."""
_IDLE = ("chrt", "--idle", "0")
"""Before a command: it then takes no CPU from any node, whatever priority the node has that starts it."""


class FaultIncidents:
    """Watches `safety_state`; keeps the newest ``number`` incidents beside the bag that ``recording`` returns, None
    while there is none. One at a time: a fault while an incident is packed, or waits for it, is in that one."""

    def __init__(self, node: Node, number: int, recording: Callable[[], Path | None]) -> None:
        self._node, self._number, self._recording = node, number, recording
        self._process: subprocess.Popen[bytes] | None = None
        self._due: tuple[float, str] | None = None
        self._seen = ""
        node.create_subscription(DiagnosticStatus, SAFETY_STATE, self._on_safety_state, LATCHED)
        node.create_timer(0.5, self._pack_when_due)

    def _on_safety_state(self, status: DiagnosticStatus) -> None:
        fault = f"{status.name} {[one.value for one in status.values]}" if status.name else ""
        if fault and fault != self._seen and self._due is None:
            self._due = time.monotonic() + _AFTER_S, status.name
        self._seen = fault

    def _pack_when_due(self) -> None:
        if self._process is not None and self._process.poll() is not None:
            if self._process.returncode:
                self._node.get_logger().warning(f"the incident was not packed: exit code {self._process.returncode}")
            self._process = None
        bag = self._recording()
        if self._due is None or time.monotonic() < self._due[0] or self._process is not None:
            return
        fault, self._due = self._due[1], None
        if bag is None:
            return
        folder = bag.absolute().with_name(f"{bag.absolute().name}_incidents")
        file = folder / f"{datetime.now():%Y_%m_%d-%H_%M_%S}_{fault}.zip"
        try:
            folder.mkdir(exist_ok=True)
            for old in sorted(folder.glob("*.zip"))[: -self._number + 1 or None]:
                old.unlink()
            words = [*_IDLE, *verb_command("incident", str(bag), "--last", str(LAST_S), "-o", str(file))]
            self._process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        except OSError as error:
            self._node.get_logger().warning(f"the incident of {fault} was not packed: {error}")
            return
        self._node.get_logger().info(f"packing the incident of {fault}: {file}")
