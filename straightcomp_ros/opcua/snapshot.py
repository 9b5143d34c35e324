"""What the gateway shows at one moment, and its alarms."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import State

ALARMS: Mapping[str, tuple[int, str]] = {
    "Fault": (900, "a node reports a fault; the amplifier is off"),
    "NodeMissing": (700, "a node of the graph is not there or does not work"),
    "NoSamples": (700, "no samples come from the machine"),
    "ErrorLimit": (500, "error of the last stroke above opcua_node's parameter error_limit"),
    "SampleLoss": (300, "samples did not come to the controller during the last ten seconds"),
    "MaintenanceDue": (200, "advice from the stage's history, see opcua_node's parameter maintenance_file"),
}
"""By name: severity as OPC UA counts (1 to 1000), and what it means."""


@dataclass(frozen=True)
class Snapshot:
    """State, message, strokes and reference of the cell's sequence, and the observation of the graph."""

    state: State = State.STOPPED
    message: str = ""
    strokes: int = 0
    strokes_done: int = 0
    centred: bool = False
    seen: Observation = field(default_factory=Observation)
    alarms: Mapping[str, str] = field(default_factory=dict)  # text by name of those that are active
    limits: Mapping[str, float] = field(default_factory=dict)  # by name, SI units; NaN where not known yet


class Alarms:
    """Finds the active alarms, with a limit of a stroke's peak-to-peak error in m."""

    def __init__(self, error_limit: float) -> None:
        self._error_limit = error_limit
        self._lost: int | None = None
        self._loss, self._loss_until = "", -math.inf

    def active(self, seen: Observation, state: State, now: float, maintenance: str = "") -> dict[str, str]:
        """Text by name of each alarm active at the monotonic time ``now``; ``maintenance`` is what is due, in words."""
        found = {"Fault": seen.fault}
        # Nothing need run in a machine that is stopped.
        if state is not State.STOPPED:
            found["NodeMissing"] = ", ".join(seen.missing)
            found["NoSamples"] = "" if seen.fresh else "no samples come in"
        if seen.stroke_error_pp > self._error_limit:
            error_um, limit_um = seen.stroke_error_pp * 1e6, self._error_limit * 1e6
            found["ErrorLimit"] = f"{error_um:.3f} µm over the last stroke; limit {limit_um:g} µm"
        before, self._lost = self._lost, seen.lost_samples
        if before is not None and seen.lost_samples > before:
            self._loss, self._loss_until = f"{seen.lost_samples - before} samples lost", now + 10.0
        found["MaintenanceDue"] = maintenance
        found["SampleLoss"] = self._loss if now < self._loss_until else ""
        return {name: text for name, text in found.items() if text}
