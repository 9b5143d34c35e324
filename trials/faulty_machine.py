"""A machine that fails on demand: wraps another machine, for trials of fault detection."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from straightcomp_ros.hardware.interface import Hardware, Sample, State, Truth
from straightcomp_ros.safety.faults import Fault, Finding

_JUMP = 5e-3
_RUN_AWAY = 1.5
"""m/s: not detected as a jump, but soon outside any map."""


def _run_away(sample: Sample, first: Sample) -> Sample:
    return sample._replace(x=sample.x - _RUN_AWAY * (sample.stamp_ns - first.stamp_ns) * 1e-9)


FAULTS: Mapping[str, tuple[Fault, Callable[[Sample, Sample], Sample]]] = {
    "sample NaN": (Fault.SAMPLE_NOT_FINITE, lambda sample, _: sample._replace(y=math.nan)),
    "sample infinite": (Fault.SAMPLE_NOT_FINITE, lambda sample, _: sample._replace(x=math.inf)),
    "y out of range": (Fault.Y_OUT_OF_RANGE, lambda sample, _: sample._replace(y=5e-3)),
    "encoder y frozen": (Fault.Y_FROZEN, lambda sample, first: sample._replace(y=first.y)),
    "encoder x frozen": (Fault.X_FROZEN, lambda sample, first: sample._replace(x=first.x)),
    "jump in x": (Fault.X_JUMP, lambda sample, _: sample._replace(x=sample.x + _JUMP)),
    "map missing for this x": (Fault.MAP_MISSING, _run_away),
    "board reports a fault": (Fault.BOARD, lambda sample, _: sample),
}
"""By name: what is found, and what each makes of a sample, given the first sample that it affects."""


class FaultyHardware:
    """Another machine, with the fault that is injected; all that has no fault is the other machine's own.

    Args:
        inner: the machine.
        began: called with the fault's name and the time (ns) of the first sample that it affects.
    """

    def __init__(self, inner: Hardware, began: Callable[[str, int], None] = lambda name, time_ns: None) -> None:
        self._inner, self._began = inner, began
        self._first: Sample | None = None
        self.injected = ""
        self._fault: Finding | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def inject(self, name: str) -> None:
        """Begin one of :data:`FAULTS` with the next sample; an empty name ends it."""
        self.injected, self._first = name, None

    def replace(self, inner: Hardware) -> None:
        """Continue with another machine, whatever state this one is in, and without a fault."""
        self._inner.close()
        self.__init__(inner, self._began)  # type: ignore[misc]

    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        samples = self._inner.read(now_ns)
        if not self.injected or not samples:
            return samples
        fault, change = FAULTS[self.injected]
        if self._first is None:
            self._first = samples[0][0]
            self._began(self.injected, now_ns)
            if fault is Fault.BOARD:
                self._fault = fault, "the board reports: overcurrent"
                self._inner.disable()
        return [(change(sample, self._first), truth) for sample, truth in samples]

    def reset_fault(self) -> None:
        self._fault = None
        self._inner.reset_fault()

    @property
    def state(self) -> State:
        return State.FAULT if self._fault else self._inner.state

    @property
    def fault(self) -> Finding | None:
        return self._fault or self._inner.fault
