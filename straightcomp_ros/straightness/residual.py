"""Straightness of a measured line: the extent of its deviation from a reference line.

ISO 230-1:2012 (test code for machine tools, geometric accuracy), clause 3.4, defines three reference lines for the
straightness error motion of a linear axis: the mean minimum zone line, the least squares line and the end-point line.
The minimum zone line gives the smallest extent, by definition. The least squares line, whose extent is close to that,
is the one that this project reports.
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


def peak_to_peak(values: ArrayLike) -> float:
    """Largest minus smallest value, in the unit of ``values``."""
    return float(np.ptp(np.asarray(values, dtype=np.float64)))
