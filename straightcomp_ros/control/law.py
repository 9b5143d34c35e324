"""The one interface of all control laws."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]


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

    A law is two functions on tuples of numbers, without side effects. A sweep over thousands of strokes compiles them
    into its loop; for all others ``run`` is the step compiled by itself, which takes the numbers as arrays. In a loop
    that finds its code in no cache, that costs a third of the same lines in Python.

    Args:
        gains: the law's constants, a NamedTuple of floats.
        start: ``start(y)`` gives the law's state at rest at y (m), with nothing integrated; a NamedTuple of floats.
        step: ``step(gains, state, y, r, r_dot, r_ddot, current)`` gives (next state, Command) for one sample: encoder
            reading y in m, reference r in m with its rate in m/s and acceleration in m/s², measured control
            current of the coils in A (NaN where none is measured).
        run: compiled ``run(gains, state, answer, y, r, r_dot, r_ddot, current)``: one step on the flat numbers of gains
            and state, which is changed in place; ``answer``, (7,), gets the numbers of the Command. None calls
            ``step`` as it is.
    """

    def __init__(
        self,
        gains: Any,
        start: Callable[[float], Any],
        step: Callable[..., tuple[Any, Command]],
        run: Any = None,
    ) -> None:
        self.gains = gains
        self.start = start
        self.function = step
        self._run = None if run is None else run.dispatcher
        self._gains = np.array(flat(gains))
        self._answer = np.zeros(len(Command._fields))
        self.reset(0.0)
        if self._run is not None:
            # The first call compiles, or reads what was compiled: it must not happen inside a loop, nor for whole
            # numbers again.
            self._run(self._gains, self._state, self._answer, 0.0, 0.0, 0.0, 0.0, math.nan)
            self._run.disable_compile()
            self.reset(0.0)

    def reset(self, y: float) -> None:
        """Start anew at rest at ``y`` (m), with nothing integrated."""
        state = self.start(y)
        self._state = state if self._run is None else np.array(flat(state))

    def step(self, y: float, r: float, r_dot: float, r_ddot: float, current: float = math.nan) -> Command:
        """Answer one sample; arguments as of the law's step function."""
        if self._run is None:
            self._state, command = self.function(self.gains, self._state, y, r, r_dot, r_ddot, current)
            return command
        self._run(self._gains, self._state, self._answer, y, r, r_dot, r_ddot, current)
        return Command(*self._answer.tolist())


def flat(numbers: Any) -> list[float]:
    """All numbers of a tuple that may have tuples in it, in order."""
    return [inner for number in numbers for inner in (flat(number) if isinstance(number, tuple) else (number,))]
