"""Straightness of a measured line: the extent of its deviation from a reference line.

ISO 230-1:2012 (test code for machine tools, geometric accuracy), clause 3.4, defines three reference lines for the
straightness error motion of a linear axis: the mean minimum zone line, the least squares line and the end-point line.
The minimum zone line gives the smallest extent, by definition (so ASME B5.57 too). The least squares line, whose extent
is close to that, is the one that verdicts and plots of this project use.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
_TANGENTS, _ROUNDING = 64, 1e-12
"""At most so many: each halves what is left, also of a width that is smooth. Relative to the zone
that it began with, what is no difference."""


def least_squares_residual(x: Array, deviation: Array, weights: Array | None = None) -> Array:
    """Deviation (n,) in m from the least squares line; its weighted mean and weighted correlation with x are zero.

    ``x``, not all the same, and ``deviation`` are (n,) in m, ``weights`` (n,) of any unit, not negative. For samples in
    time, give the speed |ẋ|: each piece of the guide then counts by its length, not by the time that the stage spends
    on it.
    """
    weight = np.ones_like(x) if weights is None else weights
    total = weight.sum()
    arm = x - (weight @ x) / total
    centred = deviation - (weight @ deviation) / total
    slope = float(weight @ (arm * centred)) / float(weight @ (arm * arm))
    return np.asarray(centred - slope * arm)


def end_point_residual(x: Array, deviation: Array) -> Array:
    """Deviation (n,) in m from the line through the first and the last point, at which it is zero; x and deviation (n,)
    in m."""
    along = (x - x[0]) / (x[-1] - x[0])
    return np.asarray(deviation - ((1.0 - along) * deviation[0] + along * deviation[-1]))


def minimum_zone(x: Array, deviation: Array) -> float:
    """Smallest distance in m, along the deviation, of two parallel lines that contain all points; x, not all the same,
    and deviation (n,) in m."""
    level = least_squares_residual(x, deviation)[None]
    return float(minimum_zones(np.zeros(1), x, level, level)[0])


def minimum_zones(slopes: Array, x: Array, high: Array, low: Array) -> Array:
    """The minimum zones (m,) in m of m sets of points, each with points at ``low`` and ``high`` (m, n) in m over x (n,)
    in m, not all the same; ``slopes`` (m,) are those of any lines to begin with.

    The width of a zone is convex and piecewise linear in its slope: none is narrower than where the tangents of two
    others meet. The narrowest is there, or its tangent takes the place of one of these (J. E. Kelley, J. SIAM 8, 1960).
    Exact but for rounding, with some six tangents.
    """
    first = narrowest = zone_along(slopes, x, high, low)[0]
    # A zone whose slope differs by more is wider than that one.
    reach = 2.0 * first / np.ptp(x)
    left, right = (np.array([at, *zone_along(at, x, high, low)]) for at in (slopes - reach, slopes + reach))
    for _ in range(_TANGENTS):
        (begin, width, falls), (end, other, rises) = left, right
        bend = rises - falls
        step = np.divide(width - other + rises * (end - begin), bend, out=np.zeros_like(bend), where=bend > 0.0)
        found = np.array([begin + step, *zone_along(begin + step, x, high, low)])
        narrowest = np.minimum(narrowest, found[1])
        if (found[1] - (width + falls * step) <= _ROUNDING * first).all():
            break
        left, right = np.where(found[2] < 0.0, found, left), np.where(found[2] < 0.0, right, found)
    return narrowest


def zone_along(slopes: Array, x: Array, high: Array, low: Array) -> tuple[Array, Array]:
    """Width (m,) in m of the zones along lines of these ``slopes`` (m,), see :func:`minimum_zones`, and its derivative
    with respect to the slope (m,) in m."""
    lines, rows = np.multiply.outer(slopes, x), np.arange(slopes.size)
    top, bottom = (high - lines).argmax(axis=1), np.subtract(low, lines, out=lines).argmin(axis=1)
    between = x[bottom] - x[top]
    return high[rows, top] - low[rows, bottom] + slopes * between, between


def rms(values: Array) -> float:
    """Root of the mean square, in the unit of ``values``; 0 without any."""
    return float(np.sqrt(np.mean(values * values))) if values.size else 0.0


def peak_to_peak(values: ArrayLike) -> float:
    """Largest minus smallest value, in the unit of ``values``."""
    return float(np.ptp(np.asarray(values, dtype=np.float64)))
