"""All faults: number, time within which they are latched, reaction, and what ends them.

What is detected, and by which node, is in the table of ``docs/safety.md``.
"""

import enum
from typing import NamedTuple

ALLOWANCE_MS = 300.0
"""Allowance for stalls of a machine without real-time scheduling, beyond a fault's own time."""
_OFF = "amplifier off, fault latched"
_RESET = "`driver/reset_fault`, then `driver/enable`"


class Description(NamedTuple):
    code: int  # the same in all versions and never used again for another fault
    within_ms: float  # longest time until it is latched, on an undisturbed machine with default parameters
    reaction: str = _OFF
    reset: str = _RESET


@enum.unique
class Fault(enum.Enum):
    """All faults."""

    COMMAND_NOT_FINITE = Description(1, 2.0)
    COMMAND_OUT_OF_RANGE = Description(2, 2.0)
    COMMAND_TIMEOUT = Description(3, 30.0)
    TWO_CONTROLLERS = Description(4, 10.0)
    SAMPLE_NOT_FINITE = Description(5, 2.0)
    X_JUMP = Description(6, 2.0)
    Y_OUT_OF_RANGE = Description(7, 2.0)
    Y_FROZEN = Description(8, 500.0)
    X_FROZEN = Description(9, 1000.0)
    CLOCK_JUMP = Description(10, 2.0)
    MAP_MISSING = Description(11, 60.0)
    SAMPLE_TIMEOUT = Description(
        12,
        1200.0,
        "amplifier off (the board by itself, where the driver is gone), fault latched",
        "start the driver again; then as the others",
    )
    HEARTBEAT_LOST = Description(
        13,
        1200.0,
        "board: amplifier off, fault latched; node: the cell ends its cycle with the amplifier off",
        "start the node again; for the board as the others",
    )
    BOARD = Description(14, 10.0)
    TRIPPED = Description(15, 60.0)
    RECORDING_STOPPED = Description(
        16,
        5000.0,
        "the bag is finished, the logger fails (the time is until its process has ended); the loop goes on",
        "free space; start the logger again, with another folder",
    )
    FOLLOWING_ERROR = Description(17, 60.0)
    CLIENT_GONE = Description(18, 1200.0)
    NOT_REFERENCED = Description(19, 10.0, reset="reference x; then as the others")

    @property
    def label(self) -> str:
        """The name in messages, logs and documents, such as ``x_jump``."""
        return self.name.lower()

    @property
    def code(self) -> int:
        """The number; 0 is no fault."""
        return self.value.code


LABELLED = {fault.label: fault for fault in Fault}
"""All faults by the names that messages have."""

Finding = tuple[Fault, str]
"""A fault, and the reason in words."""


HELD_UP = (Fault.COMMAND_TIMEOUT, Fault.SAMPLE_TIMEOUT, Fault.Y_OUT_OF_RANGE, Fault.Y_FROZEN)
"""Faults that may be latched after a stall of a node, its peers or the whole machine: without commands the platform may
reach its stop before the timeout."""
