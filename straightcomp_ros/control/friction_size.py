"""Size of friction relative to a model, by recursive least squares with forgetting.

The disturbance that an observer estimates, d in m/s², is fitted by

    d = c + b r + s F̄

with the reference r and F̄, the acceleration by the nominal friction model. F̄ passes the lag that the observer's estimate
has (three poles of first order), so that both sides of the equation are equally late. c takes what is constant, b an
error of the magnets' stiffness; without them both would be taken for friction. s is the size of friction.

Normal equations and forgetting as in Åström and Wittenmark, Adaptive Control, 2nd ed. 1995, ch. 2. Forgetting lets the
covariance P grow where nothing excites a direction; it is held below `_LARGEST_VARIANCE`, and the fit is paused while
the reference rests.
"""

import math
from typing import NamedTuple

from straightcomp_ros.model.compiled import compilable

_FIRST_VARIANCE = 1.0
"""Of c, b times the travel, and s, in units of the variance of one sample's disturbance."""
_LARGEST_VARIANCE = 10.0
_SMALLEST_SIZE = 0.1
"""Without friction in the law the fit has nothing to correct: too little is harmless, none would be a dead end."""
_SLOWEST = 2e-6
"""m/s; below this rate of the reference the fit is paused."""


class SizeGains(NamedTuple):
    """Constants of the fit.

    Attributes:
        kept: weight that the past keeps from one sample to the next.
        follow: weight of a new value in each of the three lags.
        travel: m, by which r is scaled.
        largest: bound of s.
    """

    kept: float
    follow: float
    travel: float
    largest: float


class Fit(NamedTuple):
    """c in m/s², b times the travel in m/s², s, the upper triangle of P, and F̄ behind one, two and three lags, m/s²."""

    constant: float
    slope: float
    size: float
    p00: float
    p01: float
    p02: float
    p11: float
    p12: float
    p22: float
    lag1: float
    lag2: float
    lag3: float


def size_gains(bandwidth: float, period: float, memory: float, travel: float, largest: float) -> SizeGains:
    """Constants for the observer's bandwidth in Hz, the period and the time constant of forgetting in s."""
    follow = 1.0 - math.exp(-2.0 * math.pi * bandwidth * period)
    return SizeGains(math.exp(-period / memory), follow, travel, largest)


def start(size: float) -> Fit:
    """The fit before the first sample."""
    p = _FIRST_VARIANCE
    return Fit(0.0, 0.0, size, p, 0.0, 0.0, p, 0.0, p, 0.0, 0.0, 0.0)


@compilable
def fitted(g: SizeGains, fit: Fit, r: float, r_dot: float, unit: float, rest: float) -> Fit:
    """The fit after one sample.

    Args:
        g: the constants.
        fit: before the sample.
        r, r_dot: reference, m and m/s.
        unit: F̄, m/s².
        rest: disturbance beyond what the law has taken for friction, m/s²; d is that and s F̄ behind the lags.
    """
    lag1 = fit.lag1 + g.follow * (unit - fit.lag1)
    lag2 = fit.lag2 + g.follow * (lag1 - fit.lag2)
    lag3 = fit.lag3 + g.follow * (lag2 - fit.lag3)
    c, b, s, p00, p01, p02, p11, p12, p22 = fit[:9]
    if abs(r_dot) < _SLOWEST:
        return Fit(c, b, s, p00, p01, p02, p11, p12, p22, lag1, lag2, lag3)
    x = r / g.travel
    k0 = p00 + p01 * x + p02 * lag3
    k1 = p01 + p11 * x + p12 * lag3
    k2 = p02 + p12 * x + p22 * lag3
    spread = g.kept + k0 + k1 * x + k2 * lag3
    # s F̄ is on both sides.
    miss = (rest - c - b * x) / spread
    return Fit(
        c + k0 * miss,
        b + k1 * miss,
        max(_SMALLEST_SIZE, min(g.largest, s + k2 * miss)),
        min(_LARGEST_VARIANCE, (p00 - k0 * k0 / spread) / g.kept),
        (p01 - k0 * k1 / spread) / g.kept,
        (p02 - k0 * k2 / spread) / g.kept,
        min(_LARGEST_VARIANCE, (p11 - k1 * k1 / spread) / g.kept),
        (p12 - k1 * k2 / spread) / g.kept,
        min(_LARGEST_VARIANCE, (p22 - k2 * k2 / spread) / g.kept),
        lag1,
        lag2,
        lag3,
    )
