"""Reference and its time derivatives for each encoder sample: what the control law is fed forward.

    r = r(x),   ṙ = r'(x) ẋ,   r̈ = r''(x) ẋ² + r'(x) ẍ

r is taken at the measured x, without lag: a quantum of 0.1 µm in x is 0.01 nm in r. ẋ and ẍ come from a
tracking filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.settings.declaration import parameter
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.map_crossfade import FADE_TIME, Lookup, blended, weight
from straightcomp_ros.straightness.stage_tracking import restarted, updated

T = TypeVar("T", float, NDArray[np.float64])

_NEVER = -(2**63)  # longer ago than any restart_gap


@dataclass(frozen=True)
class FeedforwardParameters:
    """Tracking of the stage."""

    bandwidth: float = parameter(30.0, "Bandwidth of the estimate of ẋ and ẍ", unit="Hz", minimum=0.1, maximum=500.0)
    restart_gap: float = parameter(
        0.05, "Time without a sample after which the estimate starts anew", unit="s", above=0.0, maximum=10.0
    )
    max_speed: float = parameter(
        1.0,
        "Speed that the stage cannot reach; a jump of x beyond it starts the estimate anew",
        unit="m/s",
        above=0.0,
        maximum=100.0,
    )

    @property
    def restart_gap_ns(self) -> int:
        """``restart_gap`` in ns."""
        return round(self.restart_gap * 1e9)


@compilable
def continues(gap_ns: int, max_speed: float, elapsed_ns: int, distance: float) -> bool:
    """Whether the estimate goes on from the last sample to one ``elapsed_ns`` and ``distance`` (m) away, or starts
    anew. A NaN compares false, so it restarts the estimate, and so does the sample after it."""
    return 0 < elapsed_ns <= gap_ns and abs(distance) <= max_speed * (elapsed_ns * 1e-9)


def rates(slope: T, curvature: T, v: T, a: T) -> tuple[T, T]:
    """ṙ in m/s and r̈ in m/s² from r', r'', ẋ and ẍ; for numbers, or arrays of one shape."""
    return slope * v, curvature * v * v + slope * a


class Feedforward:
    """r, ṙ, r̈ for each sample; deterministic, so that a replayed bag gives the same numbers."""

    def __init__(
        self, straightness: StraightnessMap, parameters: FeedforwardParameters = FeedforwardParameters()
    ) -> None:
        self._reference: Lookup = straightness.reference
        self._left: Lookup | None = None
        self._left_ns = 0
        self._bandwidth = parameters.bandwidth
        self._restart_gap_ns = parameters.restart_gap_ns
        self._max_speed = parameters.max_speed
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._stamp_ns = _NEVER
        self._left = None
        self._x = 0.0
        self._tracked = restarted(0.0)
        self._last = (0.0, 0.0, 0.0)

    @property
    def changing(self) -> bool:
        """Whether an earlier map is still being left."""
        return self._left is not None

    def change(self, reference: Lookup) -> None:
        """Go over to another map's ``reference`` within :data:`~.crossfade.FADE_TIME`, without a bump; at once before
        the first sample. Not while an earlier map is still being left."""
        if self._stamp_ns != _NEVER:
            self._left, self._left_ns = self._reference, self._stamp_ns
        self._reference = reference

    def step(self, stamp_ns: int, x: float) -> tuple[float, float, float]:
        """r in m, ṙ in m/s, r̈ in m/s² for the sample of ``stamp_ns`` at ``x`` in m.

        Lost samples do no harm: times are taken from the stamps. A repeated stamp gives the last answer
        again and changes nothing. The estimate starts anew (ṙ = r̈ = 0 once) on the first sample, a stamp
        that goes back, a gap longer than ``restart_gap``, an x that moved faster than ``max_speed``, and an
        x that is not finite, for which the answer is NaN.
        """
        elapsed_ns = stamp_ns - self._stamp_ns
        if elapsed_ns == 0:
            return self._last
        if continues(self._restart_gap_ns, self._max_speed, elapsed_ns, x - self._x):
            tracked = updated(self._bandwidth, self._tracked, elapsed_ns * 1e-9, x)
        else:
            tracked = restarted(x)
        self._tracked = tracked
        self._stamp_ns = stamp_ns
        self._x = x
        r, slope, curvature = self._reference(x)
        self._last = (r, *rates(slope, curvature, tracked.v, tracked.a))
        if self._left is not None:
            self._last = self._fade(self._left, x, self._last)
        return self._last

    def _fade(self, left: Lookup, x: float, new: tuple[float, float, float]) -> tuple[float, float, float]:
        elapsed = (self._stamp_ns - self._left_ns) * 1e-9
        if not 0.0 <= elapsed < FADE_TIME:
            self._left = None
            return new
        r, slope, curvature = left(x)
        old = (r, *rates(slope, curvature, self._tracked.v, self._tracked.a))
        return blended(old, new, weight(elapsed, FADE_TIME))
