"""States, commands and transitions of PackML (ANSI/ISA-TR88.00.02) that the cell has.

Suspended and its two transient states are left out: the cell knows no machine upstream or downstream of it.
"""

from collections.abc import Mapping
from enum import Enum, IntEnum


class State(IntEnum):
    """State of the cell, with PackML's numbers."""

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
    """A command that leads to another state, with PackML's numbers."""

    RESET = 1
    START = 2
    STOP = 3
    HOLD = 4
    UNHOLD = 5
    ABORT = 8
    CLEAR = 9
    COMPLETE = 10


class Order(Enum):
    """A command that changes reference or motion and keeps the state; the value is the name of its OPC UA method."""

    RELOAD_MAP = "ReloadMap"
    CENTER = "Center"
    OVERRIDE = "Override"
    JOG = "Jog"


_ABORTABLE = sorted(set(State) - {State.ABORTING, State.ABORTED})
_STOPPABLE = sorted(set(_ABORTABLE) - {State.STOPPING, State.STOPPED, State.CLEARING})

ACCEPTED: Mapping[Command, Mapping[State, State]] = {
    Command.RESET: dict.fromkeys((State.STOPPED, State.COMPLETE), State.RESETTING),
    Command.START: {State.IDLE: State.STARTING},
    Command.STOP: dict.fromkeys(_STOPPABLE, State.STOPPING),
    Command.HOLD: {State.EXECUTE: State.HOLDING},
    Command.UNHOLD: {State.HELD: State.UNHOLDING},
    Command.ABORT: dict.fromkeys(_ABORTABLE, State.ABORTING),
    Command.CLEAR: {State.ABORTED: State.CLEARING},
    Command.COMPLETE: {State.EXECUTE: State.COMPLETING},
}
"""By command: the states that accept it, each with the state that follows."""
ORDERED_IN = (State.IDLE, State.EXECUTE, State.HELD, State.COMPLETE)
"""States that accept an order, but for a jog: the nodes work and no other transition is running."""

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
"""The state that follows when a state's work is done. All other states wait for a command."""

FAILED: Mapping[State, State] = {
    # Resetting has switched nothing on: an amplifier that is on then is another client's, unless it gets to Idle.
    State.RESETTING: State.STOPPED,
    State.STARTING: State.STOPPING,
    **dict.fromkeys(
        (State.CLEARING, State.EXECUTE, State.HOLDING, State.UNHOLDING, State.COMPLETING, State.STOPPING),
        State.ABORTING,
    ),
}
"""The state that follows when a state's work fails."""


def refusal(asked: Command | Order, state: State) -> str:
    """Why ``state`` does not accept a command or an order; empty if it does."""
    ordered = (State.EXECUTE,) if asked is Order.JOG else ORDERED_IN
    accepting = ordered if isinstance(asked, Order) else tuple(ACCEPTED[asked])
    if state in accepting:
        return ""
    return f"{name(asked)} is not accepted in state {name(state)}; accepted in: {', '.join(map(name, accepting))}"


def name(value: State | Command | Order) -> str:
    """The name as PackML writes it, e.g. ``Execute``."""
    return value.value if isinstance(value, Order) else value.name.capitalize()
