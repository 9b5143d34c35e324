"""The cubic spline through the points of a survey."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


def cubic_spline(x: NDArray[np.float64], values: NDArray[np.float64]) -> CubicSpline:
    """Spline with continuous curvature ("not-a-knot" at its ends).

    Args:
        x: (n,) ascending, m.
        values: (n,) m.
    """
    # SciPy takes half of the time that a node needs to start, and a node without a map needs none of it.
    from scipy.interpolate import CubicSpline

    return CubicSpline(x, values)
