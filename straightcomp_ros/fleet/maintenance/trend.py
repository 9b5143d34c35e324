"""The trend of a figure: the median of all slopes between weeks, which a bad week does not move (Theil, Sen)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

WEEK = 7
MONTH = 365.25 / 12.0
_FEWEST_WEEKS = 5


class Trend(NamedTuple):
    """Change a month in the figure's unit, with its 95 % interval, and the level at the trend's end."""

    slope: float
    low: float
    high: float
    level: float

    @property
    def certain(self) -> bool:
        """Whether the interval leaves no doubt about the sign."""
        return self.low > 0.0 or self.high < 0.0


def trend_of(day: NDArray[np.int64], levels: NDArray[np.float64]) -> Trend | None:
    """The trend over ``day`` (n,) of ``levels`` (n,), NaN left out; None with less than five weeks.

    Medians of weeks are compared, since days that follow each other are alike: they share the weather.
    """
    from scipy.stats import theilslopes

    known = np.isfinite(levels)
    day, levels = day[known], levels[known]
    if not day.size:
        return None
    week = (day[-1] - day) // WEEK
    weeks = np.unique(week)
    if weeks.size < _FEWEST_WEEKS:
        return None
    at = np.array([day[week == one].mean() for one in weeks])
    values = np.array([np.median(levels[week == one]) for one in weeks])
    slope, middle, low, high = theilslopes(values, at, 0.95)
    return Trend(slope * MONTH, low * MONTH, high * MONTH, float(middle + slope * day[-1]))
