"""The faults: what is detected, by whom, within what time, what happens then, and what ends it.

This is the one place; ``docs/safety.md`` has its table from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

ALLOWANCE_MS = 300.0
"""Added to a fault's own time on a machine without real-time scheduling: it stalls that long at times."""
_OFF = "amplifier off, fault latched"
_RESET = "`driver/reset_fault`, then `driver/enable`"


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        name: as in messages and in the topic `safety_state`.
        detected: what is seen, and by what limit.
        by: the node that sees it.
        within_ms: from its beginning until it is latched, on an undisturbed machine, with default parameters.
        reaction: what happens.
        reset: what ends it.
    """

    name: str
    detected: str
    by: str
    within_ms: float
    reaction: str = _OFF
    reset: str = _RESET


_ALL = (
    Fault("command_not_finite", "a command of NaN or ±infinity", "driver", 2.0),
    Fault("command_out_of_range", "a command beyond ± `current_limit`", "driver", 2.0),
    Fault(
        "command_timeout",
        "no command, or only commands that are older, for `command_timeout`: controller, feedforward or the "
        "connection has failed",
        "driver, and the board by itself",
        30.0,
    ),
    Fault(
        "two_controllers",
        "commands for samples that have been answered already: each adds 4 strikes, a good one takes 1 off; at 16",
        "driver",
        10.0,
    ),
    Fault("sample_not_finite", "x or y is NaN or infinite", "driver", 2.0),
    Fault("x_jump", "x moved faster than `watch.max_speed`", "driver", 2.0),
    Fault("y_out_of_range", "|y| beyond `watch.y_limit`, after it has been within", "driver", 2.0),
    Fault(
        "y_frozen",
        "y has not changed by a count for `watch.frozen_time`, though the mean control current has moved by more than "
        "`watch.frozen_current`: no friction holds against that",
        "driver",
        500.0,
    ),
    Fault(
        "x_frozen",
        "x has not changed by a count while the stage's trajectory went on by `watch.follow_distance`",
        "driver",
        1000.0,
    ),
    Fault("clock_jump", "the system's clock was stepped by more than `watch.clock_step`", "driver", 2.0),
    Fault("map_missing", "x is beyond the map and the length over which it runs out", "feedforward", 60.0),
    Fault(
        "sample_timeout",
        "no sample for `sample_timeout`: the driver or the machine is gone",
        "controller, and on CAN the driver",
        1200.0,
        "amplifier off (the board by itself, where the driver is gone), fault latched",
        "start the driver again; then as the others",
    ),
    Fault(
        "heartbeat_lost",
        "CAN: no heartbeat of the board for `can.heartbeat_timeout`; a node: none for 1 s (in the "
        "cell: `heartbeat_timeout`)",
        "driver (board), cell (nodes)",
        1200.0,
        "board: amplifier off, fault latched; node: the cell ends its cycle with the amplifier off",
        "start the node again; for the board as the others",
    ),
    Fault("board", "the board reports a fault, has restarted, or does not switch on", "driver", 10.0),
    Fault("tripped", "somebody asked for it on the topic `trip`", "driver", 60.0),
    Fault(
        "recording_stopped",
        "the disk is full, or the bag cannot be written",
        "logger",
        5000.0,
        "the bag is finished, the logger fails (the time is until its process has ended); the loop goes on",
        "free space; start the logger again, with another folder",
    ),
)
FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in _ALL}
"""All faults by name."""


def table() -> str:
    """The faults as a table in Markdown."""
    rows = ["| fault | detected | by | within [ms] | reaction | reset |", "|---|---|---|---|---|---|"]
    for fault in _ALL:
        cells = (f"`{fault.name}`", fault.detected, fault.by, f"{fault.within_ms:g}", fault.reaction, fault.reset)
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


HELD_UP = ("command_timeout", "sample_timeout", "y_out_of_range", "y_frozen")
"""What a fault may be called where a node stood still, its peers were held up, or the whole machine stood still:
without commands the platform goes to its stop, and may be there before the time is out."""
