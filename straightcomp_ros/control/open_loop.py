"""No law: the current is zero, and only an excitation moves the platform."""

import math
from typing import NamedTuple

from straightcomp_ros.control.law import Command


class Gains(NamedTuple):
    """It has none."""


class State(NamedTuple):
    """It remembers nothing."""


def start(y: float) -> State:
    """See :class:`~straightcomp_ros.control.law.Law`."""
    return State()


def step(
    gains: Gains, state: State, y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> tuple[State, Command]:
    """See :class:`~straightcomp_ros.control.law.Law`."""
    return state, Command(0.0, r - y, math.nan, 0.0, 0.0, math.nan, math.nan)
