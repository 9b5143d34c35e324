"""States, commands and transitions of PackML (ANSI/ISA-TR88.00.02), as far as this machine has them.

Suspended and its two neighbours are left out: no machine before or behind this one is known here.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum


class State(IntEnum):
    """State of the machine, with PackML's numbers."""

    CLEARING = 1
    STOPPED = 2
    STARTING = 3
    IDLE = 4
    EXECUTE = 6
    STOPPING = 7
    ABORTING = 8
    ABORTED = 9
    HOLDING = 10
    HELD = 11
    UNHOLDING = 12
    RESETTING = 15
    COMPLETING = 16
    COMPLETE = 17


class Command(IntEnum):
    """What may be asked of the machine, with PackML's numbers."""

    RESET = 1
    START = 2
    STOP = 3
    HOLD = 4
    UNHOLD = 5
    ABORT = 8
    CLEAR = 9
    COMPLETE = 10


_STOPPABLE = frozenset(State) - {State.STOPPING, State.STOPPED, State.ABORTING, State.ABORTED, State.CLEARING}
_ABORTABLE = frozenset(State) - {State.ABORTING, State.ABORTED}

ACCEPTED: Mapping[Command, Mapping[State, State]] = {
    Command.RESET: dict.fromkeys((State.STOPPED, State.COMPLETE), State.RESETTING),
    Command.START: {State.IDLE: State.STARTING},
    Command.STOP: dict.fromkeys(sorted(_STOPPABLE), State.STOPPING),
    Command.HOLD: {State.EXECUTE: State.HOLDING},
    Command.UNHOLD: {State.HELD: State.UNHOLDING},
    Command.ABORT: dict.fromkeys(sorted(_ABORTABLE), State.ABORTING),
    Command.CLEAR: {State.ABORTED: State.CLEARING},
    Command.COMPLETE: {State.EXECUTE: State.COMPLETING},
}
"""By command, the states that accept it and where it leads."""

DONE: Mapping[State, State] = {
    State.RESETTING: State.IDLE,
    State.STARTING: State.EXECUTE,
    State.EXECUTE: State.COMPLETING,
    State.HOLDING: State.HELD,
    State.UNHOLDING: State.EXECUTE,
    State.COMPLETING: State.COMPLETE,
    State.STOPPING: State.STOPPED,
    State.ABORTING: State.ABORTED,
    State.CLEARING: State.STOPPED,
}
"""Where a state leads by itself when its work is done. All others wait for a command."""

FAILED: Mapping[State, State] = {
    State.RESETTING: State.STOPPING,
    State.STARTING: State.STOPPING,
    **dict.fromkeys((State.CLEARING, State.EXECUTE, State.HOLDING, State.UNHOLDING), State.ABORTING),
    **dict.fromkeys((State.COMPLETING, State.STOPPING), State.ABORTING),
}
"""Where a state leads whose work cannot be done. Trouble in the graph leads to Aborting wherever it is counted on."""


def refusal(command: Command, state: State) -> str:
    """Why ``command`` is not accepted in ``state``; empty where it is."""
    if state in ACCEPTED[command]:
        return ""
    allowed = ", ".join(name(possible) for possible in ACCEPTED[command])
    return f"{name(command)} is not accepted in state {name(state)}; accepted in: {allowed}"


def name(value: State | Command) -> str:
    """As PackML writes it, e.g. ``Execute``."""
    return value.name.capitalize()
