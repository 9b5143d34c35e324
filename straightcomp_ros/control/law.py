"""The one interface of all control laws."""

from __future__ import annotations

from typing import NamedTuple, Protocol


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


class Law(Protocol):
    """A control law, called once for each sample, at a fixed period."""

    def reset(self, y: float) -> None:
        """Start anew at rest at ``y`` (m), with nothing integrated."""

    def step(self, y: float, r: float, r_dot: float, r_ddot: float) -> Command:
        """Answer one sample.

        Args:
            y: encoder reading, m.
            r: reference, m, with its rate in m/s and acceleration in m/s².
        """
