"""The graph as seen from outside at one moment."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

ABSENT, SILENT, PLAIN = "absent", "silent", "plain"
"""States of a node that says no lifecycle state: it is not there, does not answer, or has no lifecycle."""
_WORKING = ("active", PLAIN)


@dataclass(frozen=True)
class Observation:
    """What the nodes say of themselves and what their streams show."""

    nodes: Mapping[str, str] = field(default_factory=dict)  # their states: one of those above, or in the lifecycle
    faults: Mapping[str, str] = field(default_factory=dict)  # by node, what is wrong; empty where all is well
    fault_code: int = 0  # of the fault that the driver has latched; 0 without one
    unrecorded: tuple[str, ...] = ()  # topics that the logger, where there is one, is not connected to
    fresh: bool = False  # samples are coming in
    amplifier_on: bool = False  # samples are coming in, and the driver says that the amplifier is on
    stamp_ns: int = 0  # of the newest sample, ns since the epoch; 0 before the first
    first_ns: int = 0  # of the first sample that was seen
    x: float = math.nan  # newest position of the stage in m; NaN before the first
    y: float = math.nan  # of the platform
    still: bool = True  # the stage has not moved for a tenth of a second
    error: float = math.nan  # newest compensation error in m
    sliding_variable: float = math.nan  # newest, m/s
    stroke_error_pp: float = math.nan  # peak-to-peak error over the stage's last finished movement, m
    samples: int = 0  # that the controller has handled since its start
    lost_samples: int = 0  # that did not come to the controller since its start

    @property
    def missing(self) -> tuple[str, ...]:
        """Nodes that do not work, with their state, e.g. ``logger (absent)``."""
        return tuple(f"{name} ({state})" for name, state in self.nodes.items() if state not in _WORKING)

    @property
    def fault(self) -> str:
        """All faults in one line; empty where there is none."""
        return "; ".join(f"{node}: {text}" for node, text in self.faults.items())

    @property
    def absence(self) -> str:
        """Which nodes do not work, or that no samples come in; empty where all is there."""
        if self.missing:
            return f"nodes that do not work: {', '.join(self.missing)}"
        return "" if self.fresh else "no samples come in"

    @property
    def obstacle(self) -> str:
        """Why a cycle cannot start now; empty where it can."""
        unrecorded = f"not recorded: {', '.join(self.unrecorded)}" if self.unrecorded else ""
        return self.fault or self.absence or unrecorded or ("" if self.still else "the stage moves")
