"""A machine that fails on demand: wraps another machine, for trials of fault detection."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from straightcomp_ros.hardware.interface import Hardware, Sample, State, Truth
from straightcomp_ros.safety.faults import Fault

_JUMP = 5e-3
_RUN_AWAY = 1.5
"""m/s: not detected as a jump, but soon outside any map."""


def _replaced(**numbers: float) -> Callable[[Sample, Sample], Sample]:
    return lambda sample, _: sample._replace(**numbers)


KINDS: Mapping[str, Callable[[Sample, Sample], Sample]] = {
    "sample_nan": _replaced(y=math.nan),
    "sample_infinite": _replaced(x=math.inf),
    "y_out_of_range": _replaced(y=5e-3),
    "y_frozen": lambda sample, first: sample._replace(y=first.y),
    "x_frozen": lambda sample, first: sample._replace(x=first.x),
    "x_jump": lambda sample, _: sample._replace(x=sample.x + _JUMP),
    "x_beyond_map": lambda sample, first: sample._replace(
        x=sample.x - _RUN_AWAY * (sample.stamp_ns - first.stamp_ns) * 1e-9
    ),
}
"""Kinds of faults, and what each makes of a sample, given the first sample that it affects."""
BOARD = "board"
"""The kind in which the board itself reports a fault."""


class FaultyHardware:
    """Another machine, with the fault that is injected; all that has no fault is the other machine's own.

    Args:
        inner: the machine.
        began: called with the kind and the time (ns) of the first sample that it affects.
    """

    def __init__(self, inner: Hardware, began: Callable[[str, int], None]) -> None:
        self._inner, self._began = inner, began
        self._first: Sample | None = None
        self.kind = self._fault = ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def inject(self, kind: str) -> None:
        """Begin with the next sample; an empty text ends it. ValueError for an unknown kind."""
        if kind and kind != BOARD and kind not in KINDS:
            raise ValueError(f"fault '{kind}' is unknown; allowed: {BOARD}, {', '.join(KINDS)}")
        self.kind, self._first = kind, None

    def replace(self, inner: Hardware) -> None:
        """Continue with another machine, whatever state this one is in, and without a fault."""
        self._inner.close()
        self.__init__(inner, self._began)  # type: ignore[misc]

    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        samples = self._inner.read(now_ns)
        if not self.kind or not samples:
            return samples
        if self._first is None:
            self._first = samples[0][0]
            self._began(self.kind, now_ns)
            if self.kind == BOARD:
                self._fault = "the board reports: overcurrent"
                self._inner.disable()
        change = KINDS.get(self.kind)
        return [(change(sample, self._first), truth) for sample, truth in samples] if change else samples

    def reset_fault(self) -> None:
        self._fault = ""
        self._inner.reset_fault()

    @property
    def state(self) -> State:
        return State.FAULT if self._fault else self._inner.state

    @property
    def fault(self) -> str:
        return self._fault or self._inner.fault

    @property
    def fault_kind(self) -> Fault | None:
        return Fault.BOARD if self._fault else self._inner.fault_kind
