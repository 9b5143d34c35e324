"""Reference and its time derivatives for each encoder sample, the feedforward of the control law.

    r = r(x),   ṙ = r'(x) ẋ,   r̈ = r''(x) ẋ² + r'(x) ẍ

r is taken at the measured x, without lag: a quantum of 0.1 µm in x is 0.01 nm in r. A fading-memory α-β-γ filter
estimates ẋ and ẍ. In steady state its gains are those of critical damping, all three poles at θ = exp(−2π bandwidth T):

    α = 1 − θ³,   β = (3/2) (1 − θ)² (1 + θ),   γ = (1 − θ)³

with x += α e, v += β e/T, a += γ e/T² (γ is twice the third gain where T²/2 is factored out). A constant
acceleration is followed without error. After a start the gains are those of the growing-memory filter, which is
least squares over all samples since then, until its α falls to the steady one: velocity is right from the third sample
on, with no transient. Sources: E. Brookner, Tracking and Kalman Filtering Made Easy, 1998, chapters 1 and 7 (critically
damped g-h-k filter, expanding- and fading-memory polynomial filters); N. Morrison, Introduction to Sequential Smoothing
and Prediction, 1969.

From one map to another the reference and its derivatives fade without a jump. The weight of the old map falls from 1 to
0 along the quintic 1 − s³(10 − 15 s + 6 s²), whose first two derivatives are zero at both ends: r, ṙ and r̈ are
continuous, and for maps that differ by D and a time T the speed changes by at most 1.875 D/T and the acceleration by
5.774 D/T², in addition to the maps' own rates.

Between the tables of a map for each direction the same weight goes over the stage's way, not over time: a guide's
hysteresis follows the travel since a reversal, whatever the speed (rolling guides are springs for some 0.1 mm after a
reversal: S. Futami, A. Furutani and S. Yoshida, Nanotechnology 1, 1990). The place between the tables is that of a
play operator (M. A. Krasnosel'skii and A. V. Pokrovskii, Systems with Hysteresis, 1989): the stage pushes a slot of
the length L along with one of its ends, forward at one, backward at the other, and at a reversal leaves that end. The
slot does not move while the stage is between its ends, so that r there is a function of x alone: at rest nothing
changes, an encoder that toggles does not switch tables, a reversal half-way goes back the same way, and because the
weight's first two derivatives are zero at both ends, r, ṙ and r̈ are continuous wherever ẋ and ẍ are. With tables D
apart and an acceleration a from the reversal on, the hand-over adds at most 1.93 D √(a/L) to ṙ and 8.7 a D/L to r̈.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.model.motion import MotionParameters
from straightcomp_ros.parameters.declaration import parameter
from straightcomp_ros.straightness.guide_map import StraightnessMap

T = TypeVar("T", float, NDArray[np.float64])
Rates = tuple[float, float, float]
Lookup = Callable[[float], Rates]

FADE_TIME = 0.5
"""s, from the old map to the new one."""

_TIMES = 200
"""Of a hand-over at which an earlier reference is compared with it: half as many find the same to 2 %."""
_NEVER = -(2**63)
"""Stamp in ns, earlier than any restart_gap before a sample."""


@dataclass(frozen=True)
class FeedforwardParameters:
    """Tracking of the stage."""

    bandwidth: float = parameter(
        30.0,
        "Least bandwidth of the filter that estimates speed and acceleration of the stage; fast ramps on a steep map "
        "raise it",
        "[0.1, 500] Hz",
    )
    restart_gap: float = parameter(
        0.05, "Time without a sample after which the estimate of speed and acceleration restarts", "(0, 10] s"
    )

    @property
    def restart_gap_ns(self) -> int:
        """``restart_gap`` in ns."""
        return round(self.restart_gap * 1e9)


class Tracked(NamedTuple):
    """Estimates of position in m, velocity in m/s and acceleration in m/s², and the number of samples in the growing
    memory, 0 once the gains are the steady ones."""

    x: float
    v: float
    a: float
    samples: int


@compilable
def restarted(x: float) -> Tracked:
    """The estimates without earlier samples: at rest at ``x`` in m."""
    return Tracked(x, 0.0, 0.0, 1)


@compilable
def updated(bandwidth: float, last: Tracked, dt: float, x: float) -> Tracked:
    """The estimates after the sample ``x`` in m, ``dt`` in s after the last one; dt may differ from sample to sample.
    ``bandwidth`` in Hz is that of the three equal poles."""
    theta = math.exp(-2.0 * math.pi * bandwidth * dt)
    fade = 1.0 - theta
    alpha = 1.0 - theta * theta * theta
    beta = 1.5 * fade * fade * (1.0 + theta)
    gamma = fade * fade * fade
    n = last.samples
    if n == 1:
        alpha, beta, gamma, n = 1.0, 1.0, 0.0, 2  # a straight line through two points
    elif n:
        product = (n + 1.0) * (n + 2.0) * (n + 3.0)
        growing = 3.0 * (3.0 * n * n + 3.0 * n + 2.0) / product
        if growing > alpha:
            alpha, beta, gamma, n = growing, 18.0 * (2.0 * n + 1.0) / product, 60.0 / product, n + 1
        else:
            n = 0
    error = x - (last.x + dt * (last.v + 0.5 * dt * last.a))
    return Tracked(
        x + (alpha - 1.0) * error,
        last.v + (dt * last.a + beta * error / dt),
        last.a + gamma * error / (dt * dt),
        n,
    )


@compilable
def continues(gap_ns: int, max_speed: float, noise: float, elapsed_ns: int, distance: float) -> bool:
    """Whether a sample ``elapsed_ns`` and ``distance`` (m) from the last one updates the estimate or restarts it;
    ``noise`` is what two readings may differ by at rest, m. A NaN compares false, so it restarts the estimate, and so
    does the sample after it."""
    return 0 < elapsed_ns <= gap_ns and abs(distance) <= max_speed * (elapsed_ns * 1e-9) + noise


def rates(slope: T, curvature: T, v: T, a: T) -> tuple[T, T]:
    """ṙ in m/s and r̈ in m/s² from r', r'', ẋ and ẍ; for numbers, or arrays of one shape."""
    return slope * v, curvature * v * v + slope * a


def weight(elapsed: float, duration: float) -> Rates:
    """Weight of the old map ``elapsed`` s after the change, its rate in 1/s and acceleration in 1/s²."""
    s = min(max(elapsed / duration, 0.0), 1.0)
    rest = 1.0 - s
    return (
        1.0 - s * s * s * (10.0 - 15.0 * s + 6.0 * s * s),
        -30.0 * s * s * rest * rest / duration,
        -60.0 * s * rest * (1.0 - 2.0 * s) / (duration * duration),
    )


def blended(old: Rates, new: Rates, fade: Rates) -> Rates:
    """r in m, ṙ in m/s and r̈ in m/s² between two references, by the old one's weight and the weight's rates."""
    w, w_dot, w_ddot = fade
    d, d_dot, d_ddot = (before - after for before, after in zip(old, new, strict=True))
    return new[0] + w * d, new[1] + w * d_dot + w_dot * d, new[2] + w * d_ddot + 2.0 * w_dot * d_dot + w_ddot * d


class Travel:
    """r in m and its derivatives by x in 1 and 1/m along a motion, from the map's table for the direction of travel,
    for one x in m after the other; before the first motion in the middle between both."""

    def __init__(self, straightness: StraightnessMap) -> None:
        self._map, self._length = straightness, straightness.reversal
        self.restart()

    def restart(self) -> None:
        """Forget the motion."""
        self._slot = math.nan  # its middle; at the first x there
        self._half = 0.5 * self._length

    def __call__(self, x: float) -> Rates:
        if math.isnan(self._slot):
            self._slot = x
        elif x > self._slot + self._half:
            self._slot = x - self._half
        elif x < self._slot - self._half:
            self._slot = x + self._half
        w, w_dot, w_ddot = weight(self._slot + self._half - x, self._length)
        # Of the forward table, over the way that is left to the slot's forward end, which falls with x.
        return blended(*self._map.tables(x), (w, -w_dot, w_ddot))


def handover(apart: float, acceleration: float, length: float) -> tuple[float, float]:
    """Largest ṙ in m/s and r̈ in m/s² that the hand-over between tables ``apart`` (m) adds within ``length`` (m), for a
    stage that has ``acceleration`` (m/s²) from the reversal on."""
    return 1.93 * apart * math.sqrt(acceleration / length), 8.7 * apart * acceleration / length


def outdated_handover(apart: float, acceleration: float, length: float, lead: float) -> float:
    """Largest error in m of a reference of ``lead`` s ago, extrapolated by its two rates, in a :func:`handover`."""
    t = np.linspace(0.0, math.sqrt(2.0 * length / acceleration), _TIMES)
    ways = (0.5 * acceleration * at**2 for at in (t, t + lead))
    (w, slope, curvature), (later, *_) = (np.transpose([weight(x, length) for x in way.tolist()]) for way in ways)
    w_dot, w_ddot = rates(slope, curvature, acceleration * t, np.full_like(t, acceleration))
    return apart * float(np.abs(later - (w + (w_dot + 0.5 * w_ddot * lead) * lead)).max())


def follower(straightness: StraightnessMap) -> Lookup:
    """What gives r and its derivatives by x along a motion: a new :class:`Travel`, or of one table the map's own."""
    return Travel(straightness) if straightness.directed else straightness.reference


def along(straightness: StraightnessMap, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """r in m and its first two derivatives by x along the motion ``x`` (n,) in m, (n,) each, as :func:`follower` gives
    them to the last bit."""
    if not straightness.directed:
        return straightness.evaluate(x)
    return tuple(np.array(list(map(Travel(straightness), x.tolist()))).reshape(-1, 3).T)


class Feedforward:
    """r, ṙ, r̈ for each sample; deterministic, so that a replayed bag gives the same numbers.

    ``highest_speed`` in m/s is what the stage cannot reach; ``noise`` as of :func:`continues`. It is tracked with
    ``bandwidth`` (Hz), which may be set.
    """

    def __init__(
        self,
        straightness: StraightnessMap,
        parameters: FeedforwardParameters = FeedforwardParameters(),
        highest_speed: float = MotionParameters().highest_speed,
        noise: float = EncoderParameters().x_noise,
    ) -> None:
        self._reference = follower(straightness)
        self._left_ns, self._max_speed, self._noise = 0, highest_speed, noise
        self.bandwidth, self._restart_gap_ns = parameters.bandwidth, parameters.restart_gap_ns
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._stamp_ns, self._x = _NEVER, 0.0
        self._left: Lookup | None = None
        if isinstance(self._reference, Travel):
            self._reference.restart()
        self._tracked = restarted(0.0)
        self._last = (0.0, 0.0, 0.0)

    @property
    def changing(self) -> bool:
        """Whether a change of the map is under way: from its first sample on, which may be long after it."""
        return self._left is not None and self._stamp_ns != self._left_ns

    def change(self, reference: Lookup) -> None:
        """Fade to another map's ``reference`` within :data:`FADE_TIME`; before the first sample, change
        at once. Not while :attr:`changing`."""
        if self._stamp_ns != _NEVER and self._left is None:
            self._left, self._left_ns = self._reference, self._stamp_ns
        self._reference = reference

    def step(self, stamp_ns: int, x: float) -> Rates:
        """r in m, ṙ in m/s, r̈ in m/s² for the sample of ``stamp_ns`` at ``x`` in m.

        The stamps give the times, also across lost samples. A repeated stamp gives the last answer again and changes
        nothing. The estimate restarts (ṙ = r̈ = 0 once) on the first sample, a stamp that goes back, a gap longer than
        ``restart_gap``, an x that moved faster than ``highest_speed``, and an x that is not finite, for which the
        answer is NaN.
        """
        elapsed_ns = stamp_ns - self._stamp_ns
        if elapsed_ns == 0:
            return self._last
        if continues(self._restart_gap_ns, self._max_speed, self._noise, elapsed_ns, x - self._x):
            self._tracked = updated(self.bandwidth, self._tracked, elapsed_ns * 1e-9, x)
        else:
            self._tracked = restarted(x)
        self._stamp_ns = stamp_ns
        self._x = x
        self._last = self._rates(self._reference, x)
        if self._left is not None:
            elapsed = (stamp_ns - self._left_ns) * 1e-9
            if 0.0 <= elapsed < FADE_TIME:
                self._last = blended(self._rates(self._left, x), self._last, weight(elapsed, FADE_TIME))
            else:
                self._left = None
        return self._last

    def _rates(self, reference: Lookup, x: float) -> Rates:
        r, slope, curvature = reference(x)
        return r, *rates(slope, curvature, self._tracked.v, self._tracked.a)
