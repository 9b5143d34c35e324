"""Huber's M-estimate: least squares that a few wild residuals hardly move.

A command that comes late once leaves a residual hundreds of times as large as the others. By plain least squares, ten
of 20,000 move the amplifier's bandwidth by a fifth. P. Huber, Robust Statistics, 1981, sections 7.6 and 7.8.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TUNING = 1.345
"""Standard deviations from which a residual counts less: of normal residuals, 95 % of the information is used."""
_NORMAL = 0.6745
"""Median of the magnitude of a normal variable, in standard deviations."""
_ROUNDS, _SETTLED = 50, 1e-9


def huber_weights(residuals: Array, least: float) -> Array:
    """Weights (n,) of squares, 1 for most.

    Args:
        residuals: (n,).
        least: smallest standard deviation that is assumed, in their unit; greater than 0.
    """
    limit = _TUNING * max(least, float(np.median(np.abs(residuals))) / _NORMAL)
    return np.minimum(1.0, limit / np.maximum(np.abs(residuals), limit))


def robust_regression(terms: Array, wanted: Array, least: float) -> tuple[Array, float]:
    """Factors (m,) of ``terms`` (n, m) that give ``wanted`` (n,), and the standard deviation of residuals that theirs
    follow from; ``least`` as for `huber_weights`."""
    weights: Array = np.ones(len(wanted))
    found: Array = np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        root, before = np.sqrt(weights), found
        found = np.asarray(np.linalg.lstsq(terms * root[:, None], wanted * root, rcond=None)[0])
        residuals = wanted - terms @ found
        weights = huber_weights(residuals, least)
        if np.abs(found - before).max() < _SETTLED:
            break
    return found, float(np.sqrt(np.mean((weights * residuals) ** 2)) / np.mean(weights == 1.0))
