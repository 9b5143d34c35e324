"""What the gateway shows at one moment, and the alarms in it."""

from __future__ import annotations

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
}
"""By name: severity as OPC UA counts (1 to 1000), and what it means."""


@dataclass(frozen=True)
class Snapshot:
    """State of the machine, what is seen of it, and the alarms.

    Attributes:
        state, message, strokes, strokes_done, centred: of the cell's sequence.
        seen: the graph.
        alarms: by name, for those that are active, the text.
        limits: by name, in SI units; NaN where not known yet.
    """

    state: State = State.STOPPED
    message: str = ""
    strokes: int = 0
    strokes_done: int = 0
    centred: bool = False
    seen: Observation = field(default_factory=Observation)
    alarms: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)


class Alarms:
    """Finds the active alarms.

    Args:
        error_limit: of a stroke's error, peak to peak, m.
    """

    def __init__(self, error_limit: float) -> None:
        self._error_limit = error_limit
        self._lost: int | None = None
        self._loss_text, self._loss_until = "", -math.inf

    def active(self, seen: Observation, state: State, now: float) -> dict[str, str]:
        """By name, the text of each alarm that is active.

        Args:
            seen: the graph.
            state: of the machine. Nothing need run in a machine that is stopped.
            now: monotonic time, s.
        """
        found = {}
        if seen.fault:
            found["Fault"] = seen.fault
        if state is not State.STOPPED:
            if seen.missing:
                found["NodeMissing"] = ", ".join(seen.missing)
            if not seen.fresh:
                found["NoSamples"] = "no samples come in"
        if seen.stroke_error_pp > self._error_limit:
            found["ErrorLimit"] = (
                f"{seen.stroke_error_pp * 1e6:.3f} µm over the last stroke; limit {self._error_limit * 1e6:g} µm"
            )
        loss = self._loss(seen, now)
        if loss:
            found["SampleLoss"] = loss
        return found

    def _loss(self, seen: Observation, now: float) -> str:
        before, self._lost = self._lost, seen.lost_samples
        if before is not None and seen.lost_samples > before:
            self._loss_text = f"{seen.lost_samples - before} samples lost"
            self._loss_until = now + 10.0
        return self._loss_text if now < self._loss_until else ""
