"""The coil current between two samples: through the amplifier, with each command from its arrival on.

A first-order amplifier under the old command until the new one arrives, a time d after the sample, gives

    i[k+1] = u_new + (u_old − u_new) exp(−ω (T − d)) + (i[k] − u_old) exp(−ω T)

with bandwidth ω and period T. With ω known, the measured currents give d for each sample: latency jitters, and a late
command arrives after the next sample. If d hardly changes, ω follows from the regression of i[k+1] on i[k], u[k−1] and
u[k].
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.identification.stretch import Recording
from straightcomp_ros.model.converters import DriveParameters

Array = NDArray[np.float64]

_EXPLAINED = 0.2
"""Largest residual of an accepted fit, as a fraction of the current's steps."""
_INSTANT = 1e9
"""Rate in rad/s of an amplifier without lag."""
_LATEST = 3
"""Delays of a command that are tried: less than so many samples."""


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
    """

    rate: float
    before: Array
    after: Array
    switch_ns: NDArray[np.int64]
    delay: float
    rate_found: bool


def current_path(recording: Recording, drive: DriveParameters) -> CurrentPath:
    """The current between the samples of ``recording``; the bandwidth of ``drive`` holds if the record gives none."""
    period = recording.period_ns * 1e-9
    converted = np.array([drive.converted(value) for value in recording.command.tolist()])
    found = [(*_regression(recording.current, asked, period), asked) for asked in (recording.command, converted)]
    open_part, rate, asked = min(found, key=lambda one: one[0])
    rate_found = open_part < _EXPLAINED
    if not rate_found:
        rate, asked = 2.0 * math.pi * drive.bandwidth, converted
    before, after, switch, late, missed = _arrivals(recording.current, asked, rate, period)
    if float(missed.std()) > _EXPLAINED * float(np.diff(recording.current).std()):
        return _interpolated(recording)
    # Small changes say little of their time.
    telling = np.abs(after - before) > 0.5 * np.abs(after - before).mean()
    delay = float(np.median((switch + late * period)[telling])) if telling.any() else math.nan
    return CurrentPath(rate, before, after, np.round(switch * 1e9).astype(np.int64), delay, rate_found)


def _interpolated(recording: Recording) -> CurrentPath:
    """Linear from sample to sample, in two steps."""
    current, following = recording.current, np.append(recording.current[1:], recording.current[-1])
    before, after = 0.75 * current + 0.25 * following, 0.25 * current + 0.75 * following
    halves = np.full(len(current), recording.period_ns // 2)
    return CurrentPath(_INSTANT, before, after, halves, math.nan, False)


def _regression(current: Array, asked: Array, period: float) -> tuple[float, float]:
    """Residual as a fraction of the current's steps, inf if no amplifier fits, and rate in rad/s."""
    steps = float(np.diff(current).std())
    terms = np.stack([current[1:-1], asked[:-2], asked[1:-1]], axis=1)
    (a, b, c), *_ = np.linalg.lstsq(terms, current[2:], rcond=None)
    if not (steps > 0.0 and 0.0 < a < 1.0 and abs(a + b + c - 1.0) < 0.05):
        return math.inf, 0.0
    return float((current[2:] - terms @ np.array([a, b, c])).std()) / steps, -math.log(a) / period


def _arrivals(
    current: Array, asked: Array, rate: float, period: float
) -> tuple[Array, Array, Array, NDArray[np.int64], Array]:
    """Old and new command in A, time of the change in s, samples by which it is late, residual in A; (n,) each."""
    n = len(current)
    following = np.append(current[1:], current[-1])
    keep = math.exp(-rate * period)
    best = (np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, np.int64), np.full(n, np.inf))
    for late in range(_LATEST):
        new = np.concatenate([np.full(late, asked[0]), asked[: n - late]])
        old = np.concatenate([new[:1], new[:-1]])
        change = old - new
        # The rest of the old command that is left after T − d: between keep (d = 0) and 1 (d = T).
        with np.errstate(divide="ignore", invalid="ignore"):
            left = (following - new - (current - old) * keep) / change
        left = np.clip(np.where(change != 0.0, left, keep), keep, 1.0)
        missed = following - (new + change * left + (current - old) * keep)
        answer = (old, new, period + np.log(left) / rate, np.full(n, late), missed)
        # The least late one that explains the step: a later one does so at times by chance.
        better = np.abs(missed) < 0.5 * np.abs(best[4]) - 1e-12
        best = tuple(np.where(better, a, b) for a, b in zip(answer, best, strict=True))  # type: ignore[assignment]
    return best
