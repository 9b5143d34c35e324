"""Friction and stiffness of a stroke as currents, from position and coil current alone: milliseconds, no model.

While the platform slides slowly, its inertia is negligible, and the magnets balance stiffness and friction:

    i_c = c − (K̄_y/K̄_i) y + (F/K̄_i) sgn ẏ

A stroke along the guide goes over the same y in both directions, so that friction shows as half the hysteresis of the
current over y. Where ẏ is near zero, and on the first micrometres after a reversal, the bristles bend, and friction has
not its full value: such samples are left out.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_SPAN = 0.05
"""Time in s over which ẏ is taken: longer than a count of the encoder takes."""
_SLIDING = 0.2
"""Fraction of the 90th percentile of |ẏ| from which the platform counts as sliding."""
_BENDING = 2e-6
"""Travel in m after a reversal in which the bristles bend: four times that of the shipped stage."""
_LEAST = 500
"""Samples of sliding in each direction."""
_LEAST_TRAVEL = 2.0 * _BENDING
"""Travel of the platform in m below which hardly any of it is sliding."""


class ForceBalance(NamedTuple):
    """Friction in A and K̄_y/K̄_i in A/m; NaN where the stroke does not tell them."""

    friction: float
    stiffness: float


def force_balance(time: NDArray[np.float64], y: NDArray[np.float64], coil_current: NDArray[np.float64]) -> ForceBalance:
    """The balance of a stroke; ``time`` in s, ``y`` in m and measured ``coil_current`` in A, (n,) each.

    Samples with NaN are left out. The values are NaN where the platform does not slide long enough both ways.
    """
    from scipy.ndimage import uniform_filter1d

    known = np.isfinite(y) & np.isfinite(coil_current)
    time, y, coil_current = time[known], y[known], coil_current[known]
    if time.size < 2 * _LEAST or np.ptp(y) < _LEAST_TRAVEL:
        return ForceBalance(math.nan, math.nan)
    width = max(3, round(_SPAN / float(np.median(np.diff(time)))))
    velocity = uniform_filter1d(np.gradient(uniform_filter1d(y, width, mode="nearest"), time), width, mode="nearest")
    turned = np.diff(np.sign(velocity), prepend=0.0) != 0.0
    turning_point = np.maximum.accumulate(np.where(turned, np.arange(y.size), 0))
    sliding = np.abs(velocity) > _SLIDING * float(np.percentile(np.abs(velocity), 90))
    sliding &= np.abs(y - y[turning_point]) > _BENDING
    way = np.sign(velocity[sliding])
    if min(np.count_nonzero(way > 0.0), np.count_nonzero(way < 0.0)) < _LEAST:
        return ForceBalance(math.nan, math.nan)
    terms = np.stack([np.ones(way.size), -y[sliding], way], axis=1)
    (_, stiffness, friction), *_ = np.linalg.lstsq(terms, coil_current[sliding], rcond=None)
    return ForceBalance(float(friction), float(stiffness))
