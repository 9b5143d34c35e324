"""Straightness of a measured line: the extent of its deviation from a reference line.

ISO 230-1:2012 (test code for machine tools, geometric accuracy), clause 3.4, defines three reference lines for the
straightness error motion of a linear axis: the mean minimum zone line, the least squares line and the end-point line.
The minimum zone line gives the smallest extent, by definition (so ASME B5.57 too). The least squares line, whose extent
is close to that, is the one that verdicts and plots of this project use.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


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
    and deviation (n,) in m.

    Exact, in O(n log n): as a function of its slope the width of the zone is convex and piecewise linear, so that it is
    smallest at the slope of an edge of the points' convex hull (M. E. Houle and G. T. Toussaint, IEEE Trans. Pattern
    Anal. Mach. Intell. 10, 1988).
    """
    from scipy.spatial import ConvexHull

    level = least_squares_residual(x, deviation)
    scale = peak_to_peak(level)
    # Of points on a line only rounding is left, and no hull of it may be found.
    if scale <= 1e-12 * peak_to_peak(deviation):
        return scale
    points = np.column_stack([(x - x[0]) / np.ptp(x), level / scale])
    corners = points[ConvexHull(points).vertices]
    along, across = corners[np.lexsort(corners.T[::-1])].T
    beyond = across - np.interp(along, along[[0, -1]], across[[0, -1]])
    beyond[[0, -1]] = 0.0
    lower, upper = beyond <= 0.0, beyond >= 0.0
    with np.errstate(divide="ignore"):
        # An edge is vertical where two points share the first or the last x.
        falling, rising = (np.diff(across[side]) / np.diff(along[side]) for side in (upper, lower))
    slopes = np.concatenate([falling, rising])
    slopes = slopes[np.isfinite(slopes)]
    above, below = np.searchsorted(-falling, -slopes), np.searchsorted(rising, slopes)
    width = across[upper][above] - across[lower][below] - slopes * (along[upper][above] - along[lower][below])
    return float(width.min()) * scale


def peak_to_peak(values: ArrayLike) -> float:
    """Largest minus smallest value, in the unit of ``values``."""
    return float(np.ptp(np.asarray(values, dtype=np.float64)))
