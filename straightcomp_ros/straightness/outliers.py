"""Readings that cannot be the guide: spikes within a run, and points or runs that differ from the others.

Both tests are Hampel's identifier: a value is an outlier if it is further from the median than ``limit`` robust
standard deviations, 1.4826 times the median absolute deviation (F. R. Hampel, J. Am. Stat. Assoc. 69, 1974). Neither
the median nor that deviation moves with the outliers themselves, as mean and standard deviation do.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

_GAUSSIAN = 1.4826
FLOOR = 20e-9
"""Distance in m from the median below which nothing is an outlier: runs that agree to a nanometre by chance must not
condemn one that differs by five."""
_WHOLE_RUN = 0.25
"""Fraction of outliers above which a run is rejected as a whole: something was knocked, or came loose."""
_WIDEST = 3
"""Most neighbouring outliers in a run; with more it is rejected too, since interpolation would be a guess."""
_FEWEST = 3
"""Fewest runs of one direction that can be compared: of two that differ, neither is known to be wrong."""


def spikes(residual: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
    """Which samples of a run are outliers; ``residual`` (n,) in m is the difference from its smooth course."""
    distance = np.abs(residual - np.median(residual))
    return np.asarray(distance > max(limit * _GAUSSIAN * float(np.median(distance)), FLOOR))


class Disagreement(NamedTuple):
    """Which runs are rejected as a whole, (runs,), and which single points of the other runs, (runs, n)."""

    runs: NDArray[np.bool_]
    points: NDArray[np.bool_]


def disagreement(values: NDArray[np.float64], limit: float) -> Disagreement:
    """Compare the runs of one direction by their ``values`` (runs, n) in m on one grid of at least four points.

    ``limit`` is in robust standard deviations, which are taken over all points.
    """
    rejected = np.zeros(len(values), np.bool_)
    points = np.zeros(values.shape, np.bool_)
    while np.count_nonzero(~rejected) >= _FEWEST:
        kept = values[~rejected]
        distance = np.abs(kept - np.median(kept, axis=0))
        # With an odd number of runs one is the median itself; its zeros would make the others' spread seem small.
        others = distance[distance > 0.0]
        spread = float(np.median(others)) if others.size else 0.0
        flagged = distance > max(limit * _GAUSSIAN * spread, FLOOR)
        stretches = sliding_window_view(flagged, _WIDEST + 1, axis=1)
        unusable = (flagged.mean(axis=1) > _WHOLE_RUN) | np.any(np.all(stretches, axis=2), axis=1)
        if not unusable.any():
            points[~rejected] = flagged
            break
        # One by one: the worst run moves the median for the others.
        worst = np.where(unusable, distance.sum(axis=1), -1.0).argmax()
        rejected[np.flatnonzero(~rejected)[worst]] = True
    return Disagreement(rejected, points)
