"""How the coil current runs between two samples: through the amplifier and the command's delay, as recorded.

A first-order amplifier that is asked for the old command until the delay is over, and then for the new one, gives

    i[k+1] = a i[k] + b u[k−1] + c u[k],   a = exp(−ωT),   c = 1 − exp(−ω (T − delay)),   a + b + c = 1

with bandwidth ω and period T: linear regression on measured currents and recorded commands gives both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.identification.recording import Recording
from straightcomp_ros.model.converters import DriveParameters

_EXPLAINED = 0.25
"""Largest part of the current's steps that the regression may leave open, to be believed."""
_INSTANT = 1e9
"""Amplifier rate in rad/s that follows at once."""


@dataclass(frozen=True, eq=False)
class CurrentPath:
    """What to ask of an amplifier of ``rate`` (rad/s) that starts each period from the measured current.

    Attributes:
        rate: of the first-order amplifier, rad/s.
        before, after: (n,) current asked for in A, from each sample and from ``switch_ns`` after it.
        switch_ns: ns.
        amplifier_bandwidth, delay: what the regression found, Hz and s; NaN where the measured current is
            interpolated instead, because the regression does not explain it.
    """

    rate: float
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    switch_ns: int
    amplifier_bandwidth: float
    delay: float


def current_path(recording: Recording, drive: DriveParameters) -> CurrentPath:
    """The current between the samples of ``recording``; ``drive`` tells the D/A converter's steps, which are tried."""
    period = recording.period_ns * 1e-9
    converted = np.array([drive.converted(value) for value in recording.command.tolist()])
    found = [_regression(recording.current, asked, period) for asked in (recording.command, converted)]
    (open_part, rate, delay), asked = min(zip(found, (recording.command, converted), strict=True), key=lambda f: f[0])
    if open_part > _EXPLAINED:
        # Straight from sample to sample, in two halves.
        current, following = recording.current, np.append(recording.current[1:], recording.current[-1])
        return CurrentPath(
            _INSTANT,
            0.75 * current + 0.25 * following,
            0.25 * current + 0.75 * following,
            recording.period_ns // 2,
            math.nan,
            math.nan,
        )
    before = np.concatenate([recording.current[:1], asked[:-1]])
    return CurrentPath(rate, before, asked, round(delay * 1e9), rate / (2.0 * math.pi), delay)


def _regression(current: NDArray[np.float64], asked: NDArray[np.float64], period: float) -> tuple[float, float, float]:
    """(open part of the current's steps, rate in rad/s, delay in s); the open part is inf where it fits nothing."""
    steps = float(np.diff(current).std())
    terms = np.stack([current[1:-1], asked[:-2], asked[1:-1]], axis=1)
    (a, b, c), *_ = np.linalg.lstsq(terms, current[2:], rcond=None)
    if not (steps > 0.0 and 0.0 < a < 1.0 and 0.0 < c < 1.0 and abs(a + b + c - 1.0) < 0.05):
        return math.inf, 0.0, 0.0
    rate = -math.log(a) / period
    delay = period + math.log(1.0 - c) / rate
    open_part = float((current[2:] - terms @ np.array([a, b, c])).std()) / steps
    return open_part, rate, min(max(delay, 0.0), period)
