"""Finds when the level of a figure changed: CUSUM control charts tell that it did, ruptures when and how.

Levels of days are compared with those of a baseline, the first four weeks. The sums

    S⁺ ← max(0, S⁺ + z − k),    S⁻ ← max(0, S⁻ − z − k),    z = (level − median of the baseline) / σ

(Page, Biometrika 41, 1954) pass the threshold h soon after a lasting change, while days that scatter both ways leave
them near zero. k and h are tuned on simulated sound stages, see docs/maintenance.md. The day of the change is where two
constants, or a constant and a slope, fit the levels best.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.maintenance.watched_figures import Watched

Array = NDArray[np.float64]
BASELINE = 28
"""Days with strokes that make the baseline."""
SLACK = 2.0
"""k: levels within so many standard deviations of the baseline's median add nothing."""
THRESHOLD = 20.0
"""h, in standard deviations."""
_WEEK = 7
_LEAST = 3
"""Days before a change, and of a slope. A step may have come on the last day."""


class LevelChange(NamedTuple):
    """A change of a figure.

    Attributes:
        figure: its name.
        begin: place of the day from which the level is another one.
        found: place of the day whose level gave the alarm.
        before, after: median of the baseline, and of the last days after the change, at most a week.
        sigma: standard deviation from day to day during the baseline.
        step: whether it came within days; otherwise the level drifts.
    """

    figure: str
    begin: int
    found: int
    before: float
    after: float
    sigma: float
    step: bool

    @property
    def lasting(self) -> bool:
        """Whether the figure is still beside its baseline: one that went back needs nobody."""
        return abs(self.after - self.before) > SLACK * self.sigma


class Chart(NamedTuple):
    """A figure against its baseline: median, standard deviation from day to day, and S⁺ and S⁻ (n,), NaN during the
    baseline and on days without a level."""

    centre: float
    sigma: float
    rising: Array
    falling: Array


def chart_of(levels: Array, watched: Watched) -> Chart | None:
    """The chart of ``levels`` (n,); None while the baseline is not complete. NaN: a day without the figure."""
    known = np.flatnonzero(np.isfinite(levels))
    if known.size <= BASELINE:
        return None
    values = levels[known]
    centre = float(np.median(values[:BASELINE]))
    sigma = max(float(values[:BASELINE].std()), watched.relative * abs(centre), watched.absolute)
    z = (values[BASELINE:] - centre) / sigma
    rising, falling = np.full((2, levels.size), np.nan)
    rising[known[BASELINE:]] = _cusum(z - SLACK)
    falling[known[BASELINE:]] = _cusum(-z - SLACK) if watched.falling else 0.0
    return Chart(centre, sigma, rising, falling)


def _cusum(steps: Array) -> Array:
    """S of S ← max(0, S + step), from 0."""
    sums = np.cumsum(steps)
    return np.asarray(sums - np.minimum(np.minimum.accumulate(sums), 0.0))


def change_of(levels: Array, watched: Watched, threshold: float = THRESHOLD) -> LevelChange | None:
    """The first change of ``levels`` (n,), None if there is none."""
    chart = chart_of(levels, watched)
    if chart is None:
        return None
    beyond = np.flatnonzero(np.fmax(chart.rising, chart.falling) > threshold)
    if not beyond.size:
        return None
    found = int(beyond[0])
    known = np.flatnonzero(np.isfinite(levels))
    begin, step = _onset(levels[known] / chart.sigma)
    recent = levels[known[begin:]][-_WEEK:]
    # It cannot have begun after it was found.
    place = min(int(known[begin]), found)
    return LevelChange(watched.name, place, found, chart.centre, float(np.median(recent)), chart.sigma, step)


def _onset(values: Array) -> tuple[int, bool]:
    """Where ``values`` (n,) change, and whether a step describes that better than a slope from there on."""
    import ruptures

    last = values.size
    step_at = int(ruptures.Binseg(model="l2", min_size=1, jump=1).fit(values).predict(n_bkps=1)[0])
    step_cost = sum(float(np.sum((part - part.mean()) ** 2)) for part in (values[:step_at], values[step_at:]))
    places = np.arange(last, dtype=np.float64)

    def ramp_cost(at: int) -> float:
        terms = np.stack([np.ones(last), np.maximum(places - at, 0.0)], axis=1)
        weights, *_ = np.linalg.lstsq(terms, values, rcond=None)
        return float(np.sum((values - terms @ weights) ** 2))

    costs = {at: ramp_cost(at) for at in range(_LEAST, last - _LEAST)}
    ramp_at = min(costs, key=costs.__getitem__)
    return (step_at, True) if step_cost <= costs[ramp_at] else (ramp_at, False)
