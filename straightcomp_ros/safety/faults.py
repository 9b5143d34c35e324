"""All faults: what is detected, by which node, within what time, the reaction, and what ends it.

The driver, `safety_state`, OPC UA and the table in ``docs/safety.md`` take them from here.
"""

import enum
from typing import NamedTuple

ALLOWANCE_MS = 300.0
"""Allowance for stalls of a machine without real-time scheduling, beyond a fault's own time."""
_OFF = "amplifier off, fault latched"
_RESET = "`driver/reset_fault`, then `driver/enable`"


class Description(NamedTuple):
    """A row of the table of faults."""

    code: int  # the same in all versions and never used again for another fault
    detected: str  # the condition, with its limit
    by: str  # the node that detects it
    within_ms: float  # longest time until it is latched, on an undisturbed machine with default parameters
    reaction: str = _OFF
    reset: str = _RESET


@enum.unique
class Fault(enum.Enum):
    """All faults."""

    COMMAND_NOT_FINITE = Description(1, "a command of NaN or ±infinity", "driver", 2.0)
    COMMAND_OUT_OF_RANGE = Description(2, "a command beyond ± `stage.actuator.current_limit`", "driver", 2.0)
    COMMAND_TIMEOUT = Description(
        3,
        "no command, or only commands that are older, for `command_timeout`: controller, feedforward or the "
        "connection has failed",
        "driver, and the board by itself",
        30.0,
    )
    TWO_CONTROLLERS = Description(
        4,
        "a command for a sample that the driver did not take, whatever its stamp; or four within 10 s for samples that "
        "have their command already (10 ms: from 400 a second)",
        "driver",
        10.0,
    )
    SAMPLE_NOT_FINITE = Description(5, "x or y is NaN or infinite", "driver", 2.0)
    X_JUMP = Description(6, "x moved faster than `stage.motion.highest_speed`", "driver", 2.0)
    Y_OUT_OF_RANGE = Description(7, "|y| beyond `watch.y_limit`, after it has been within", "driver", 2.0)
    Y_FROZEN = Description(
        8,
        "y has not changed by a count for `watch.frozen_time`, though the mean control current has moved by more than "
        "`watch.frozen_current`: no friction holds against that",
        "driver",
        500.0,
    )
    X_FROZEN = Description(
        9,
        "x has not changed by a count while the stage's trajectory went on by `watch.follow_distance`",
        "driver",
        1000.0,
    )
    CLOCK_JUMP = Description(10, "the system's clock was stepped by more than `watch.clock_step`", "driver", 2.0)
    MAP_MISSING = Description(11, "x is beyond the map and the length over which it runs out", "feedforward", 60.0)
    SAMPLE_TIMEOUT = Description(
        12,
        "no sample for `sample_timeout`: the driver or the machine is gone",
        "controller, and on CAN the driver",
        1200.0,
        "amplifier off (the board by itself, where the driver is gone), fault latched",
        "start the driver again; then as the others",
    )
    HEARTBEAT_LOST = Description(
        13,
        "CAN: no heartbeat of the board for `can.heartbeat_timeout`; a node: none for 1 s (in the "
        "cell: `heartbeat_timeout`)",
        "driver (board), cell (nodes)",
        1200.0,
        "board: amplifier off, fault latched; node: the cell ends its cycle with the amplifier off",
        "start the node again; for the board as the others",
    )
    BOARD = Description(14, "the board reports a fault, has restarted, or does not switch on", "driver", 10.0)
    TRIPPED = Description(15, "a message on the topic `trip`", "driver", 60.0)
    RECORDING_STOPPED = Description(
        16,
        "the disk is full, or the bag cannot be written",
        "logger",
        5000.0,
        "the bag is finished, the logger fails (the time is until its process has ended); the loop goes on",
        "free space; start the logger again, with another folder",
    )
    FOLLOWING_ERROR = Description(
        17,
        "|r − y| beyond `error_limit`, after it has been within; or y farther than `watch.travel` from where the "
        "amplifier was switched on; or an excitation in open loop has moved the platform by `excitation.travel`",
        "controller; `watch.travel`: driver, within a sample",
        60.0,
    )
    CLIENT_GONE = Description(
        18,
        "the client that commissions the machine has ended, or was not awake for 1 s, and has left the amplifier on",
        "driver",
        1200.0,
    )

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


def table() -> str:
    """The faults as a table in Markdown."""
    rows = ["| fault | code | detected | by | within [ms] | reaction | reset |", "|---|---|---|---|---|---|---|"]
    for fault in Fault:
        code, detected, by, within_ms, reaction, reset = fault.value
        cells = (f"`{fault.label}`", f"{code}", detected, by, f"{within_ms:g}", reaction, reset)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


HELD_UP = (Fault.COMMAND_TIMEOUT, Fault.SAMPLE_TIMEOUT, Fault.Y_OUT_OF_RANGE, Fault.Y_FROZEN)
"""Faults that may be latched after a stall of a node, its peers or the whole machine: without commands the platform may
reach its stop before the timeout."""
