"""How a figure changes from day to day: when its level changed, its trend, and where the guide moved.

CUSUM control charts find that a level changed, a fit when and how.

Levels of days are compared with those of a baseline, the first four weeks. The sums

    S⁺ ← max(0, S⁺ + z − k),    S⁻ ← max(0, S⁻ − z − k),    z = (level − median of the baseline) / σ

(Page, Biometrika 41, 1954) pass the threshold h soon after a lasting change, while days that scatter both ways leave
them near zero. An alarm stands until the figure is back, then the sums begin anew; each day is judged by what was known
on it. k and h are tuned on simulated sound stages, see docs/evidence/history.md. The day of the change is where two
constants, or a constant and a slope, fit the levels best.

A parabola over the whole length is left out of the guide's profiles: the sensor's straight edge may be put down anew,
and guides bow with the temperature of what they are mounted on. What is left is local.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import Array
from straightcomp_ros.fleet.history.rows import BIN_MM
from straightcomp_ros.fleet.maintenance.day_levels import BASELINE, Watched

SLACK = 2.0
"""k: levels within so many standard deviations of the baseline's median add nothing."""
THRESHOLD = 25.0
"""h, in standard deviations."""
_MOST_ALIKE = 0.8
"""Largest correlation of a day with the next that is read from a baseline: of four weeks it is uncertain."""
_BACK = 1.0
"""A figure is back when the median of its last week is within so many standard deviations of the baseline's median, or
on the other side of it."""
WEEK = 7
MONTH = 365.25 / 12.0
_FEWEST_WEEKS = 5
"""Of a trend."""
_EDGE = 0.3
"""Fraction of the largest change at which the moved place ends."""
_LEAST = 3
"""Days before a change, and of a slope. A step may have come on the last day."""


class LevelChange(NamedTuple):
    """A change of a figure."""

    figure: str  # its name
    begin: int  # place of the day from which the level is another one
    found: int  # place of the day whose level gave the alarm
    ended: int | None  # place of the day from which the level counts as back at its baseline; None while it is not
    before: float  # median of the baseline
    days: tuple[int, ...]  # places of the last days of the change, at most a week
    after: float  # median of these days
    step: bool  # whether it came within days; otherwise the level drifts

    @property
    def lasting(self) -> bool:
        """Whether the figure is still off its baseline: one that went back needs no work."""
        return self.ended is None


class Baseline(NamedTuple):
    """The median of the first days of a figure, and the standard deviation from day to day that they let expect."""

    centre: float
    sigma: float


def baseline_of(levels: Array, watched: Watched) -> Baseline | None:
    """The baseline of ``levels`` (n,); None while it is not complete. NaN: a day without the figure."""
    values = levels[np.isfinite(levels)][:BASELINE]
    if values.size < BASELINE:
        return None
    centre = float(np.median(values))
    return Baseline(centre, max(_scatter(values), watched.relative * abs(centre), watched.absolute))


def _scatter(values: Array) -> float:
    """Standard deviation of later days about the mean of ``values`` (n,).

    Days that are alike count as fewer, n (1 − ρ) / (1 + ρ) with the correlation ρ of a day with the next: from few days
    the standard deviation comes out too small, and the mean is not that of the year.
    """
    scatter = float(values.std())
    if scatter == 0.0:
        return 0.0
    off = values - values.mean()
    alike = min(max(float(off[1:] @ off[:-1] / (off @ off)), 0.0), _MOST_ALIKE)
    days = values.size * (1.0 - alike) / (1.0 + alike)
    return scatter * math.sqrt((days + 1.0) / (days - 1.0))


def changes_of_figure(levels: Array, watched: Watched) -> list[LevelChange]:
    """The changes of ``levels`` (n,) in the order of time; each day's judgement is by what was known then."""
    baseline = baseline_of(levels, watched)
    if baseline is None:
        return []
    known = np.flatnonzero(np.isfinite(levels))
    values = levels[known]
    changes, start = [], 0
    for found, ended in _alarms((values - baseline.centre) / baseline.sigma, watched.falling):
        # Until the week that was judged to be back.
        stop = values.size if ended is None else ended - WEEK + 1
        begin, step = _onset(values[start:stop] / baseline.sigma)
        # It cannot have begun after it was found.
        begin = min(start + begin, found)
        last = slice(max(begin, stop - WEEK), stop)
        days, after = tuple(known[last].tolist()), float(np.median(values[last]))
        when = (int(known[begin]), int(known[found]), None if ended is None else int(known[ended]))
        changes.append(LevelChange(watched.name, *when, baseline.centre, days, after, step))
        start = stop
    return changes


def _alarms(z: Array, falling: bool) -> list[tuple[int, int | None]]:
    """When the sums passed the threshold, and when the figure was back; from then on they begin at 0 again."""
    alarms: list[tuple[int, int | None]] = []
    high = low = 0.0
    side = 0  # 1 while an alarm of a rise stands, -1 of a fall
    for place in range(BASELINE, z.size):
        if not side:
            high = max(0.0, high + z[place] - SLACK)
            low = max(0.0, low - z[place] - SLACK) if falling else 0.0
            side = int(high > THRESHOLD) - int(low > THRESHOLD)
            if side:
                alarms.append((place, None))
        elif place - alarms[-1][0] >= WEEK and side * np.median(z[place - WEEK + 1 : place + 1]) < _BACK:
            alarms[-1] = (alarms[-1][0], place)
            high = low = 0.0
            side = 0
    return alarms


def _onset(values: Array) -> tuple[int, bool]:
    """Where ``values`` (n,) change, and whether a step describes that better than a slope from there on."""
    places = np.arange(values.size, dtype=np.float64)

    def cost(change: Array) -> float:
        """Sum of squares about a constant and the multiple of ``change`` that fit best."""
        terms = np.stack([np.ones(values.size), change], axis=1)
        weights, *_ = np.linalg.lstsq(terms, values, rcond=None)
        return float(np.sum((values - terms @ weights) ** 2))

    steps = {at: cost((places >= at).astype(np.float64)) for at in range(1, values.size)}
    slopes = {at: cost(np.maximum(places - at, 0.0)) for at in range(_LEAST, values.size - _LEAST)}
    step_at, slope_at = (min(costs, key=costs.__getitem__) for costs in (steps, slopes))
    return (step_at, True) if steps[step_at] <= slopes[slope_at] else (slope_at, False)


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

    It is the median of all slopes between weeks, which a bad week does not move (Theil, Sen). Medians of weeks are
    compared, since days that follow each other are alike: they share the weather.
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


class Place(NamedTuple):
    """A stretch of the guide in mm."""

    first: int
    last: int


def moved_place(shift: Array, x: Array) -> Place:
    """Where a change ``shift`` (m,) in µm over ``x`` (m,) in m is largest, to where it falls below a third of that."""
    # The parabola through a guide that moved in one place lies off zero elsewhere.
    size = np.abs(shift - np.nanmedian(shift))
    peak = int(np.nanargmax(size))
    small = np.flatnonzero(np.nan_to_num(size) <= _EDGE * size[peak])
    first, last = max(small[small < peak], default=-1) + 1, min(small[small > peak], default=size.size) - 1
    return Place(round(float(x[first]) * 1e3 - BIN_MM / 2), round(float(x[last]) * 1e3 + BIN_MM / 2))
