"""The one interface of all control laws."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from straightcomp_ros.model.compiled import Compiled, compiling, is_ours

_FLAT_STEP = """\
def run(k, s, answer, y, r, r_dot, r_ddot, current):
    state, command = step({gains}, {state}, y, r, r_dot, r_ddot, current)
    {stored}
"""
"""Source of a law's compiled step, with elements of arrays for the fields of its tuples."""


class Command(NamedTuple):
    """A law's answer to a sample.

    Attributes:
        current: control current i_c in A, within the limit.
        error: r − y in m.
        sliding_variable: σ in m/s.
        equivalent_current, switching_current: i_c without switching and its switching part, A, before the limit.
        velocity_estimate: the law's estimate of ẏ, m/s.
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

    A law is two functions on tuples of numbers, without side effects. A sweep compiles them into its loop; for all
    others the step is compiled by itself, on arrays of the same numbers, when it is first asked for. With a cold cache,
    as in the graph, that takes a third of the time of the same lines in Python.

    Args:
        gains: the law's constants, a NamedTuple of floats.
        start: ``start(y)`` gives the law's state at rest at y (m), with nothing integrated; a NamedTuple of floats.
        step: ``step(gains, state, y, r, r_dot, r_ddot, current)`` gives (next state, Command) for one sample: encoder
            reading y in m, reference r in m with its rate in m/s and acceleration in m/s², measured control
            current of the coils in A (not finite where none is measured).
        compiled: whether the step, and what it calls, has the decorator ``compilable`` of
            ``straightcomp_ros.model.compiled``; otherwise :meth:`step` calls the Python function.
        unrest: path of the number in a compiled law's state that says for how long the platform has not come to rest,
            such as ``.rest.restless``; an excitation keeps it at zero.
    """

    def __init__(
        self,
        gains: Any,
        start: Callable[[float], Any],
        step: Callable[..., tuple[Any, Command]],
        compiled: bool = False,
        unrest: str = "",
    ) -> None:
        self.gains, self.start, self.function = gains, start, step
        self._unrest = _place(start(0.0).__class__, unrest) if unrest else -1
        self._run: Callable[..., None] | None = self._first if compiled else None
        self._gains = np.array(flat(gains) if compiled else [], np.float64)
        self._answer = np.zeros(len(Command._fields))
        self.reset(0.0)

    def prepare(self) -> Law:
        """Compile the step, or read its machine code, now: inside a loop the first call of :meth:`step` must not."""
        if self._run is not None:
            with compiling():
                run = _flat_step(self.function, self.gains.__class__, self.start(0.0).__class__).dispatcher
                run(self._gains, np.array(self._state), self._answer, 0.0, 0.0, 0.0, 0.0, math.nan)
                # Nor again for integers.
                run.disable_compile()
            self._run = run
        return self

    def _first(self, *arguments: Any) -> None:
        self.prepare()
        assert self._run is not None
        self._run(*arguments)

    def reset(self, y: float) -> None:
        """Restart at rest at ``y`` (m), with nothing integrated."""
        state = self.start(y)
        self._state = state if self._run is None else np.array(flat(state), np.float64)

    def excited(self) -> None:
        """A test signal moves the platform: that it does not come to rest says nothing of its friction."""
        if self._unrest >= 0:
            self._state[self._unrest] = 0.0

    def step(self, y: float, r: float, r_dot: float, r_ddot: float, current: float = math.nan) -> Command:
        """Answer one sample; arguments as of the law's ``step``."""
        if self._run is None:
            self._state, command = self.function(self.gains, self._state, y, r, r_dot, r_ddot, current)
            return command
        self._run(self._gains, self._state, self._answer, y, r, r_dot, r_ddot, current)
        # Past the constructor that NamedTuple writes in Python: a tenth of the step.
        return tuple.__new__(Command, self._answer.tolist())

    def answer_from(self, state: Sequence[float], y: float, current: float = math.nan) -> tuple[list[float], Command]:
        """The next state and the command for one sample with the reference at rest at zero.

        ``state`` has all numbers of a state, in order, as of :func:`flat`. The law's own state stays as it is.
        """
        if self._run is None:
            before = _rebuilt(self.start(0.0), iter(state))
            after, command = self.function(self.gains, before, y, 0.0, 0.0, 0.0, current)
            return flat(after), command
        numbers, answer = np.array(state, np.float64), np.zeros(len(Command._fields))
        self._run(self._gains, numbers, answer, y, 0.0, 0.0, 0.0, current)
        return numbers.tolist(), Command(*answer.tolist())


def flat(numbers: Any) -> list[float]:
    """All numbers of nested tuples, in order."""
    return [inner for number in numbers for inner in (flat(number) if isinstance(number, tuple) else (number,))]


def _rebuilt(like: Any, numbers: Iterator[float]) -> Any:
    """Nested tuples as ``like`` with other numbers: the inverse of :func:`flat`."""
    return type(like)(*(_rebuilt(value, numbers) if isinstance(value, tuple) else next(numbers) for value in like))


@cache
def _flat_step(step: Callable[..., Any], gains: type, state: type) -> Compiled:
    """``run(gains, state, answer, y, r, r_dot, r_ddot, current)``: one step on arrays.

    It changes ``state`` in place, and fills ``answer``, (7,), with the numbers of the Command.
    """
    names: dict[str, Any] = {"step": step, "__name__": step.__module__}
    stored = [f"s[{n}] = state{path}" for n, path in enumerate(_paths(state))]
    stored += [f"answer[{n}] = command{path}" for n, path in enumerate(_paths(Command))]
    source = _FLAT_STEP.format(
        gains=_from_array("k", gains, itertools.count(), names),
        state=_from_array("s", state, itertools.count(), names),
        stored="\n    ".join(stored),
    )
    # numba caches by the source's file, and reads its text from the function's first line on: those of the law's step.
    source = "\n" * (step.__code__.co_firstlineno - 1) + source
    exec(compile(source, step.__code__.co_filename, "exec"), names)
    return Compiled(names["run"], cached=is_ours(step))


def _from_array(array: str, kind: type, places: Iterator[int], names: dict[str, Any]) -> str:
    """Source of a call that makes a tuple of ``kind`` from an array; adds its names to ``names``."""
    parts = [
        _from_array(array, field, places, names) if issubclass(field, tuple) else f"{array}[{next(places)}]"
        for field in get_type_hints(kind).values()
    ]
    name = f"{kind.__name__}_{len(names)}"
    names[name] = kind
    return f"{name}({', '.join(parts)})"


@cache
def _place(state: type, path: str) -> int:
    """Where the number at ``path`` stands in a flat ``state``."""
    return list(_paths(state)).index(path)


def _paths(kind: type) -> Iterator[str]:
    """Attribute paths of the numbers of a tuple of ``kind``, in order, such as ``.prior.y``."""
    for name, field in get_type_hints(kind).items():
        yield from (f".{name}{inner}" for inner in (_paths(field) if issubclass(field, tuple) else ("",)))
