"""What clients may ask of the reference, besides PackML's commands: the machine's state stays what it is."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

from straightcomp_ros.opcua.packml import State, name


class Order(Enum):
    """By the name of its method."""

    RELOAD_MAP = "ReloadMap"
    CENTER = "Center"


_AT_WORK = (State.IDLE, State.EXECUTE, State.HELD, State.COMPLETE)
ORDERED_IN: Mapping[Order, tuple[State, ...]] = {Order.RELOAD_MAP: _AT_WORK, Order.CENTER: _AT_WORK}
"""By order, the states that accept it: those in which the nodes work and nothing else is under way."""


def order_refusal(order: Order, state: State) -> str:
    """Why ``order`` is not accepted in ``state``; empty where it is."""
    if state in ORDERED_IN[order]:
        return ""
    allowed = ", ".join(name(possible) for possible in ORDERED_IN[order])
    return f"{order.value} is not accepted in state {name(state)}; accepted in: {allowed}"
