"""Gain, offset, bandwidth and delay of the way from a command to the measured current, whatever its sign."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.signal import lfilter

from straightcomp_ros.analysis.current_path import huber_weights
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.tuning.commissioning.machine import Array, Series

_LONGEST = 8
"""Samples of delay."""
_DELAYS = (0.1, 0.5, 0.9)
"""Parts of a sample, where the search begins."""
_BANDWIDTHS = np.geomspace(0.005, 2.0, 13)
"""Relative to the sampling rate, likewise."""
_STARTS = 2
_EXACT = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
_LOWEST, _HIGHEST = math.log(1e-4), math.log(100.0)
"""Logarithms of the amplifier's rate times the period."""
_ROUNDS, _SETTLED = 30, 1e-7
_LEAST = 1e-4
"""Standard deviation of the residuals relative to that of the current, below which they count as none."""
_UNEXPLAINED = 0.9
"""Share of the current from which no amplifier fits."""


@dataclass(frozen=True)
class CurrentReadback:
    """The way from command to readback.

    Attributes:
        gain: measured current per commanded current, at rest.
        offset: measured current without a command, A.
        bandwidth: of a first-order amplifier, Hz; NaN if none fits.
        delay: of a command, samples; NaN likewise.
        unexplained: RMS of what such an amplifier leaves, relative to that of the steps of the current.
    """

    gain: float
    offset: float
    bandwidth: float
    delay: float
    unexplained: float


def current_readback(series: Series, drive: DriveParameters, period: float) -> CurrentReadback:
    """The way in ``series``, whose commands must change at random; ``period`` of the samples in s.

    The current of each candidate amplifier is computed from the commands alone, so that a readback of few counts does
    no harm; its gain and offset follow by least squares.
    """
    acting = slice(series.left_at)
    asked = np.array([drive.converted(command) for command in series.command[acting].tolist()])
    current = series.current[acting]
    known = np.isfinite(current)
    asked, current = asked[known], current[known]

    trust = np.ones(asked.size)

    def fitted(numbers: Array) -> tuple[Array, Array]:
        """(gain, offset), and residuals (n,) in A."""
        terms = np.stack([_answer(asked, math.exp(numbers[0]), float(numbers[1])), np.ones(asked.size)], axis=1)
        root = np.sqrt(trust)
        factors, *_ = np.linalg.lstsq(terms * root[:, None], current * root, rcond=None)
        return np.asarray(factors), np.asarray(current - terms @ factors)

    def residuals(numbers: Array) -> Array:
        return np.asarray(np.sqrt(trust) * fitted(numbers)[1])

    scale = max(1e-12, float(current.std()))

    def searched(start: Array, whole: int) -> OptimizeResult:
        """The best delay from ``whole`` samples to one more."""
        # At a whole one the current is not smooth in the delay, and a search does not pass.
        bounds = ([_LOWEST, whole], [_HIGHEST, whole + 1.0])
        return least_squares(
            lambda numbers: residuals(numbers) / scale, np.clip(start, *bounds), bounds=bounds, **_EXACT
        )

    found = []
    for whole in range(_LONGEST):
        starts = [np.array([math.log(2.0 * math.pi * band), whole + part]) for band in _BANDWIDTHS for part in _DELAYS]
        starts.sort(key=lambda start: float(np.sum(residuals(start) ** 2)))
        found += [searched(start, whole) for start in starts[:_STARTS]]
    best: Array = min(found, key=lambda one: float(one.cost)).x
    # Late commands have moved it, perhaps beyond a whole sample.
    for _ in range(_ROUNDS):
        trust, before = huber_weights(fitted(best)[1], _LEAST * scale), best
        wholes = {min(_LONGEST - 1, max(0, math.floor(before[1] + side))) for side in (-0.5, 0.5)}
        best = min((searched(before, whole) for whole in wholes), key=lambda one: float(one.cost)).x
        if np.abs(best - before).max() < _SETTLED:
            break
    (gain, offset), left = fitted(best)
    missed = float(left.std()) / max(1e-12, float(np.diff(current).std()))
    if float(left.std()) > _UNEXPLAINED * scale or gain == 0.0:
        return CurrentReadback(float(gain), math.nan, math.nan, math.nan, missed)
    return CurrentReadback(
        float(gain), float(offset), math.exp(best[0]) / (2.0 * math.pi * period), float(best[1]), missed
    )


def _answer(asked: Array, rate: float, delay: float) -> Array:
    """The current (n,) at each sample of an amplifier that gets the commands ``asked`` (n,) after ``delay`` samples.

    With ω T = ``rate`` and the delay's fraction p of a period, i[k+1] = a i[k] + (b − a) u[k−w−1] + (1 − b) u[k−w],
    a = exp(−ω T), b = exp(−ω T (1 − p)).
    """
    whole = math.floor(delay)
    kept, late = math.exp(-rate), math.exp(-rate * (1.0 - (delay - whole)))
    shifted = np.concatenate([np.zeros(whole + 1), asked])[: asked.size]
    older = np.concatenate([[0.0], shifted])[: asked.size]
    return np.asarray(lfilter([1.0], [1.0, -kept], (1.0 - late) * shifted + (late - kept) * older))
