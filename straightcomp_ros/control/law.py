"""The one interface of all control laws."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple


class Command(NamedTuple):
    """What a law answers to a sample: the control current, and why.

    Attributes:
        current: control current i_c in A, within the limit.
        error: r − y in m.
        sliding_variable: σ in m/s.
        equivalent_current: the part of i_c without switching, in A, before the limit.
        switching_current: the switching part of i_c in A, before the limit.
        velocity_estimate: ẏ as the law sees it, m/s.
        disturbance_estimate: m/s², NaN where the law estimates none.
    """

    current: float
    error: float
    sliding_variable: float
    equivalent_current: float
    switching_current: float
    velocity_estimate: float
    disturbance_estimate: float


class Law:
    """A control law, called once for each sample at a fixed period.

    A law is two functions on tuples of numbers, without side effects: the running graph calls them as they
    are, and a sweep over thousands of strokes compiles the very same functions.

    Args:
        gains: the law's constants, a NamedTuple of floats.
        start: ``start(y)`` gives the law's state at rest at y (m), with nothing integrated; a NamedTuple of floats.
        step: ``step(gains, state, y, r, r_dot, r_ddot, current)`` gives (next state, Command) for one sample: encoder
            reading y in m, reference r in m with its rate in m/s and acceleration in m/s², measured control
            current of the coils in A (NaN where none is measured).
    """

    def __init__(self, gains: Any, start: Callable[[float], Any], step: Callable[..., tuple[Any, Command]]) -> None:
        self.gains = gains
        self.start = start
        self.function = step
        self.reset(0.0)

    def reset(self, y: float) -> None:
        """Start anew at rest at ``y`` (m), with nothing integrated."""
        self._state = self.start(y)

    def step(self, y: float, r: float, r_dot: float, r_ddot: float, current: float = math.nan) -> Command:
        """Answer one sample; arguments as of the law's step function."""
        self._state, command = self.function(self.gains, self._state, y, r, r_dot, r_ddot, current)
        return command
