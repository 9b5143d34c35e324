"""Gain, offset, bandwidth and delay of the way from a command to the measured current, whatever its sign."""

import math
from dataclasses import dataclass

import numpy as np

from straightcomp_ros.commissioning.machine import Series
from straightcomp_ros.model.converters import DriveParameters

_AGES = 4
"""Commands that may act in a period: the newest and so many before it, less one."""
_ACTED = 0.02


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

    From sample to sample a first-order amplifier gives i[k+1] = a i[k] + Σ b_j u[k−j] + c, with a = exp(−ω T). The
    steps b_j sum to (1 − a) times the gain; which of them act tells the delay.
    """
    acting = slice(series.left_at)
    asked = np.array([drive.converted(command) for command in series.command[acting].tolist()])
    current = series.current[acting]
    last = len(current) - 1
    commands = [asked[_AGES - 1 - age : last - age] for age in range(_AGES)]
    terms = np.stack([current[_AGES - 1 : last], *commands, np.ones(last - _AGES + 1)], axis=1)
    weights, *_ = np.linalg.lstsq(terms, current[_AGES:], rcond=None)
    kept, steps = float(weights[0]), weights[1:-1]
    missed = float((current[_AGES:] - terms @ weights).std()) / max(1e-12, float(np.diff(current).std()))
    gain = float(steps.sum()) / (1.0 - kept)
    if not (0.0 < kept < 1.0 and gain != 0.0):
        return CurrentReadback(gain, math.nan, math.nan, math.nan, missed)
    rate = -math.log(kept) / period
    risen = np.cumsum(steps) / gain
    whole = int(np.argmax(risen > _ACTED * (1.0 - kept)))
    # Of the newest command that acts, 1 − exp(−ω (T − d)) has come by the next sample.
    part = 1.0 + math.log(max(1e-9, 1.0 - float(risen[whole]))) / (rate * period)
    offset = float(weights[-1]) / (1.0 - kept)
    return CurrentReadback(gain, offset, rate / (2.0 * math.pi), whole + min(1.0, max(0.0, part)), missed)
