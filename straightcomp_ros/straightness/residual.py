"""Straightness of a measured line: the extent of its deviation from a reference line.

ISO 230-1:2012 (test code for machine tools, geometric accuracy), clause 3.4, defines three reference lines for the
straightness error motion of a linear axis: the mean minimum zone line, the least squares line and the end-point line.
The minimum zone line gives the smallest extent, by definition. The least squares line, whose extent is close to that,
is the one that this project reports.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def least_squares_residual(x: ArrayLike, deviation: ArrayLike, weights: ArrayLike | None = None) -> NDArray[np.float64]:
    """Deviation (n,) in m from the least squares line; its weighted mean and weighted correlation with x are zero.

    Args:
        x, deviation: (n,) in m.
        weights: (n,) of any unit, not negative. For samples in time, give the speed |ẋ|: each piece of the
            guide then counts by its length, not by the time that the stage spends on it.

    Raises:
        ValueError: shapes differ, there are fewer than two points, or all x with weight are the same.
    """
    x_values, values = _points(x, deviation)
    weight = np.ones_like(x_values) if weights is None else np.asarray(weights, dtype=np.float64)
    if weight.shape != x_values.shape:
        raise ValueError(f"weights have shape {weight.shape}, x has {x_values.shape}; allowed: the same")
    total = weight.sum()
    if not total > 0.0:
        raise ValueError(f"weights add up to {total:g}; allowed: > 0")
    arm = x_values - (weight @ x_values) / total
    moment = weight @ (arm * arm)
    if not moment > 0.0:
        raise ValueError("all x are the same; a line needs two different positions")
    centred = values - (weight @ values) / total
    slope = float(weight @ (arm * centred)) / float(moment)
    return np.asarray(centred - slope * arm)


def end_point_residual(x: ArrayLike, deviation: ArrayLike) -> NDArray[np.float64]:
    """Deviation (n,) in m from the line through the first and the last point, at which it is zero; x and deviation (n,)
    in m.

    Raises:
        ValueError: shapes differ, there are fewer than two points, or both ends are at the same x.
    """
    x_values, values = _points(x, deviation)
    length = x_values[-1] - x_values[0]
    if length == 0.0:
        raise ValueError(f"both end points are at x = {x_values[0]:g} m; a line needs two different positions")
    along = (x_values - x_values[0]) / length
    return np.asarray(values - ((1.0 - along) * values[0] + along * values[-1]))


def peak_to_peak(values: ArrayLike) -> float:
    """Largest minus smallest value, in the unit of ``values``."""
    return float(np.ptp(np.asarray(values, dtype=np.float64)))


def _points(x: ArrayLike, deviation: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x_values, values = np.asarray(x, dtype=np.float64), np.asarray(deviation, dtype=np.float64)
    if x_values.ndim != 1 or x_values.shape != values.shape:
        raise ValueError(f"x has shape {x_values.shape}, deviation {values.shape}; allowed: both (n,)")
    if x_values.size < 2:
        raise ValueError(f"{x_values.size} points; allowed: >= 2")
    return x_values, values
