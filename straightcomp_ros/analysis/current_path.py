"""The coil current between two samples: through the amplifier, with each command from its arrival on.

A first-order amplifier under the old command until the new one arrives, a time d after the sample, gives

    i[k+1] = u_new + (u_old − u_new) exp(−ω (T − d)) + (i[k] − u_old) exp(−ω T)

with bandwidth ω and period T. With ω known, the measured currents give d for each sample: latency jitters, and a late
command arrives after the next sample. If d hardly changes, ω follows from the regression of i[k+1] on i[k] and on all
commands that a delay of less than :data:`_LATEST` samples may leave in action: the record tells which of them act.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.huber import robust_regression
from straightcomp_ros.analysis.stretch import Recording
from straightcomp_ros.model.converters import DriveParameters

Array = NDArray[np.float64]

_EXPLAINED = 0.2
"""Largest residual of an accepted fit, as a fraction of the current's steps."""
_INSTANT = 1e9
"""Rate in rad/s of an amplifier without lag."""
_ACTED = 0.02
"""Share of its full effect in a period from which a command counts as having acted in it."""
_PERCENTILES = (5.0, 50.0, 95.0)
_LATEST = 3
"""Delays of a command that are looked for: less than so many samples."""
_USUAL = 0.99
"""Share of the samples that an accepted fit must explain; commands that are late now and then are in the others."""
_EXACT = 1e-4
"""Standard deviation of the residuals relative to the current's steps, below which they count as none."""


@dataclass(frozen=True, eq=False)
class CurrentPath:
    """Commands for an amplifier that starts each period from the measured current.

    Attributes:
        rate: of the first-order amplifier, rad/s.
        before, after: (n,) commanded current in A, from each sample and from ``switch_ns`` after it.
        switch_ns: (n,) int64 ns.
        delay: median time from a sample to the arrival of its command, s; NaN where the measured current is
            interpolated, because no amplifier explains it.
        rate_found: whether the rate comes from the record, or else from the parameters.
        rate_deviation: standard deviation of a rate from the record by its residuals, rad/s; 0 for one from elsewhere.
        delay_spread: delays in s that a twentieth of the commands come before, and after; NaN with ``delay``.
    """

    rate: float
    before: Array
    after: Array
    switch_ns: NDArray[np.int64]
    delay: float
    rate_found: bool
    rate_deviation: float
    delay_spread: tuple[float, float]


def current_path(recording: Recording, drive: DriveParameters) -> CurrentPath:
    """The current between the samples of ``recording``; the bandwidth of ``drive`` holds if the record gives none."""
    period = recording.period_ns * 1e-9
    converted = np.array([drive.converted(value) for value in recording.command.tolist()])
    found = [(*_regression(recording.current, asked, period), asked) for asked in (recording.command, converted)]
    open_part, rate, deviation, usual, asked = min(found, key=lambda one: one[0])
    rate_found = open_part < _EXPLAINED
    if not rate_found:
        rate, deviation, usual, asked = 2.0 * math.pi * drive.bandwidth, 0.0, 0, converted
    before, after, switch, late, missed = _arrivals(recording.current, asked, rate, period, usual)
    if float(missed.std()) > _EXPLAINED * float(np.diff(recording.current).std()):
        return _interpolated(recording)
    # Small changes say little of their time.
    telling = np.abs(after - before) > 0.5 * np.abs(after - before).mean()
    soonest, delay, latest = math.nan, math.nan, math.nan
    if telling.any():
        soonest, delay, latest = np.percentile((switch + late * period)[telling], _PERCENTILES).tolist()
    switch_ns = np.round(switch * 1e9).astype(np.int64)
    return CurrentPath(rate, before, after, switch_ns, delay, rate_found, deviation, (soonest, latest))


def _interpolated(recording: Recording) -> CurrentPath:
    """Linear from sample to sample, in two steps."""
    current, following = recording.current, np.append(recording.current[1:], recording.current[-1])
    before, after = 0.75 * current + 0.25 * following, 0.25 * current + 0.75 * following
    halves = np.full(len(current), recording.period_ns // 2)
    return CurrentPath(_INSTANT, before, after, halves, math.nan, False, 0.0, (math.nan, math.nan))


def _regression(current: Array, asked: Array, period: float) -> tuple[float, float, float, int]:
    """Residual as a fraction of the current's steps, inf if no amplifier fits; rate and its standard deviation, rad/s;
    whole samples of delay."""
    steps, last = float(np.diff(current).std()), len(current) - 1
    if not steps > 0.0:
        return math.inf, 0.0, 0.0, 0
    commands = [asked[_LATEST - age : last - age] for age in range(_LATEST + 1)]
    terms = np.stack([current[_LATEST:last], *commands], axis=1)
    weights, spread = robust_regression(terms, current[_LATEST + 1 :], _EXACT * steps)
    kept = float(weights[0])
    if not (0.0 < kept < 1.0 and abs(float(weights.sum()) - 1.0) < 0.05):
        return math.inf, 0.0, 0.0, 0
    # The youngest command that has acted within the period: of those before it, something is left.
    whole = int(np.argmax(np.cumsum(weights[1:]) > _ACTED * (1.0 - kept)))
    deviation = spread * math.sqrt(float(np.linalg.pinv(terms.T @ terms)[0, 0])) / (kept * period)
    missed = np.sort(np.abs(current[_LATEST + 1 :] - terms @ weights))[: round(_USUAL * len(terms))]
    left = float(np.sqrt(np.mean(missed**2)))
    return left / steps, -math.log(kept) / period, deviation, whole


def _arrivals(
    current: Array, asked: Array, rate: float, period: float, usual: int
) -> tuple[Array, Array, Array, NDArray[np.int64], Array]:
    """Old and new command in A, time of the change in s, samples by which it is late, residual in A; (n,) each.

    ``usual`` is by how many samples most commands are late.
    """
    n = len(current)
    following = np.append(current[1:], current[-1])
    keep = math.exp(-rate * period)
    best = (np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, np.int64), np.full(n, np.inf))
    for late in sorted(range(_LATEST), key=lambda late: abs(late - usual)):
        new = np.concatenate([np.full(late, asked[0]), asked[: n - late]])
        old = np.concatenate([new[:1], new[:-1]])
        change = old - new
        # The rest of the old command that is left after T − d: between keep (d = 0) and 1 (d = T).
        with np.errstate(divide="ignore", invalid="ignore"):
            left = (following - new - (current - old) * keep) / change
        left = np.clip(np.where(change != 0.0, left, keep), keep, 1.0)
        missed = following - (new + change * left + (current - old) * keep)
        answer = (old, new, period + np.log(left) / rate, np.full(n, late), missed)
        # The usual one, if it explains the step: another one does so at times by chance.
        better = np.abs(missed) < 0.5 * np.abs(best[4]) - 1e-12
        best = tuple(np.where(better, a, b) for a, b in zip(answer, best, strict=True))  # type: ignore[assignment]
    return best
