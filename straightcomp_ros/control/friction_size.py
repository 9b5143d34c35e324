"""Size of friction relative to a model, by recursive least squares with forgetting.

The disturbance that an observer estimates, d in m/s², is fitted by

    d = c + b r + s F̄

with the reference r and F̄ = −F̂/(s M). The observer's estimate lags: with the poles p, p and q it follows an
acceleration u, which acts from one sample to the next, by

    (1 − p)² (1 − q) z (z + 1) / (2 (z − p)² (z − q)) u,

and F̄ passes the same lag before it is compared. c takes what is constant, b an error of the magnets' stiffness; without
them both would be taken for friction. s is the size of friction.

Normal equations and forgetting as in Åström and Wittenmark, Adaptive Control, 2nd ed. 1995, ch. 2. Forgetting lets the
covariance P grow where nothing excites a direction: nothing is forgotten while the trace of P would exceed
`_LARGEST_TRACE`, and the fit is paused while the reference rests.
"""

from typing import NamedTuple

from straightcomp_ros.model.compiled import compilable

_FIRST_VARIANCE = 1.0
"""Of c, b times the travel, and s, in units of the variance of one sample's disturbance."""
_LARGEST_TRACE = 30.0
_SMALLEST_SIZE = 0.1
"""Without friction in the law the fit has nothing to correct: too little is harmless, none would be a dead end."""


class SizeGains(NamedTuple):
    """Constants of the fit.

    Attributes:
        kept: weight that the past keeps from one sample to the next.
        smooth, mean: weights of a new value in the smoothed misfit, and in its mean square.
        travel: m, by which r is scaled.
        speed: |ṙ| in m/s up to which the fit is paused.
        largest: bound of s.
    """

    kept: float
    smooth: float
    mean: float
    travel: float
    speed: float
    largest: float


class LagWeights(NamedTuple):
    """Weights of a new value in the lags of the observer's double pole and of its third pole."""

    double: float
    third: float


class Lags(NamedTuple):
    """The last F̄ and the one before, and their mean behind one, two and three lags, m/s²."""

    last: float
    before: float
    first: float
    second: float
    third: float


class Fit(NamedTuple):
    """c in m/s², b times the travel in m/s², s, the upper triangle of P, the misfit, and the lags of F̄.

    The misfit is what c + b r + s F̄ leaves of d, smoothed, m/s², and the mean of its square.
    """

    constant: float
    slope: float
    size: float
    p00: float
    p01: float
    p02: float
    p11: float
    p12: float
    p22: float
    misfit: float
    misfit_square: float
    lags: Lags


def fit_at_start(size: float) -> Fit:
    """The fit before the first sample."""
    p = _FIRST_VARIANCE
    return Fit(0.0, 0.0, size, p, 0.0, 0.0, p, 0.0, p, 0.0, 0.0, Lags(0.0, 0.0, 0.0, 0.0, 0.0))


@compilable
def lagged(g: LagWeights, lags: Lags, unit: float) -> Lags:
    """The lags at the next sample; ``unit`` is F̄ until then."""
    first = lags.first + g.double * (0.5 * (lags.last + lags.before) - lags.first)
    second = lags.second + g.double * (first - lags.second)
    return Lags(unit, lags.last, first, second, lags.third + g.third * (second - lags.third))


@compilable
def fitted(g: SizeGains, weights: LagWeights, fit: Fit, r: float, r_dot: float, unit: float, others: float) -> Fit:
    """The fit after one sample.

    Args:
        g: the constants.
        weights: of the observer's lags.
        fit: before the sample.
        r, r_dot: reference, m and m/s.
        unit: F̄ from this sample to the next, m/s².
        others: the observer's disturbance without friction, m/s²; with s F̄ behind the lags it is d.
    """
    lags = lagged(weights, fit.lags, unit)
    if abs(r_dot) <= g.speed:
        return Fit(*fit[:11], lags)
    c, b, s, p00, p01, p02, p11, p12, p22 = fit[:9]
    x, f = r / g.travel, lags.third
    k0 = p00 + p01 * x + p02 * f
    k1 = p01 + p11 * x + p12 * f
    k2 = p02 + p12 * x + p22 * f
    spread = g.kept + k0 + k1 * x + k2 * f
    # s F̄ is on both sides of the equation.
    left = others - c - b * x
    miss = left / spread
    misfit = fit.misfit + g.smooth * (left - fit.misfit)
    square = fit.misfit_square + g.mean * (misfit * misfit - fit.misfit_square)
    p00, p01, p02 = p00 - k0 * k0 / spread, p01 - k0 * k1 / spread, p02 - k0 * k2 / spread
    p11, p12, p22 = p11 - k1 * k1 / spread, p12 - k1 * k2 / spread, p22 - k2 * k2 / spread
    grow = 1.0 / g.kept if p00 + p11 + p22 <= _LARGEST_TRACE * g.kept else 1.0
    s = max(_SMALLEST_SIZE, min(g.largest, s + k2 * miss))
    return Fit(
        c + k0 * miss,
        b + k1 * miss,
        s,
        grow * p00,
        grow * p01,
        grow * p02,
        grow * p11,
        grow * p12,
        grow * p22,
        misfit,
        square,
        lags,
    )
