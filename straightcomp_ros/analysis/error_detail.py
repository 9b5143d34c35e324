"""The compensation error of a run in more detail: its spectrum, and the stick-slip of the platform.

In stick-slip the platform stands while its reference moves on, then jumps after it.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BANDS = ((0.0, 10.0), (10.0, 100.0), (100.0, 1000.0))
"""Bands in Hz of the reported errors: map and friction, the loop's own bandwidth, noise and chatter."""
SEGMENT = 1.0
"""Length in s of the segments that are averaged: lines 1 Hz apart."""
_PEAKS = 5
STUCK = 0.4e-6
"""Way in m by which the reference runs on while the platform stands, that makes a stick: four counts of the encoder."""
STANDING = 0.15e-6
"""Distance in m within which the platform counts as standing: one count of 0.1 µm to and fro."""
SLIP_TIME = 0.02
"""Time in s after a stick within which the platform must have jumped."""
SLIP = 0.5
"""Part of the stick that the platform makes good in that time, beyond the reference's own motion."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One-sided power spectral density: frequency (m,) in Hz, density (m,) in m²/Hz; empty for too few samples."""

    frequency: NDArray[np.float64]
    density: NDArray[np.float64]

    def band_rms(self, low: float, high: float) -> float:
        """RMS in m of the band from ``low`` (inclusive) to ``high`` Hz; NaN for an empty spectrum."""
        if not len(self.density):
            return math.nan
        inside = (self.frequency >= low) & (self.frequency < high)
        step = self.frequency[1] - self.frequency[0] if len(self.frequency) > 1 else 0.0
        return float(np.sqrt(self.density[inside].sum() * step))

    def peaks(self) -> list[tuple[float, float]]:
        """Frequency in Hz and density in m²/Hz of the highest local maxima, highest first."""
        inner = self.density[1:-1]
        places = 1 + np.flatnonzero((inner > self.density[:-2]) & (inner >= self.density[2:]))
        highest = places[np.argsort(self.density[places])[::-1][:_PEAKS]]
        return [(float(self.frequency[place]), float(self.density[place])) for place in highest]


def error_spectrum(time: NDArray[np.float64], error: NDArray[np.float64]) -> Spectrum:
    """Spectrum by Welch's method: segments of :data:`SEGMENT` that overlap by half, Hann window, mean removed.

    ``error`` (n,) in m is interpolated where samples are missing in ``time`` (n,) in s, rising.
    Source: P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70–73.
    """
    if len(time) < 16:
        return Spectrum(np.empty(0), np.empty(0))
    # This import takes half a second.
    from scipy.signal import welch

    period = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1] + 0.5 * period, period)
    values = np.interp(grid, time, error)
    return Spectrum(*welch(values, 1.0 / period, nperseg=min(round(SEGMENT / period), len(grid))))


@dataclass(frozen=True)
class StickSlip:
    """One event: began at ``time`` (s) and ``x`` (m), stood for ``duration`` (s), then jumped by ``slip`` (m)."""

    time: float
    x: float
    duration: float
    slip: float


def stick_slips(
    time: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64], r: NDArray[np.float64]
) -> list[StickSlip]:
    """The events in one stroke; all arrays (n,), in s and m, as the encoders see them."""
    events = []
    for start, stop in _standing(y):
        ahead = r[stop - 1] - r[start]
        if abs(ahead) < STUCK:
            continue
        until = int(np.searchsorted(time, time[stop - 1] + SLIP_TIME))
        way = np.sign(ahead)
        gained = way * ((y[stop - 1 : until + 1] - y[stop - 1]) - (r[stop - 1 : until + 1] - r[stop - 1]))
        if len(gained) and gained.max() >= SLIP * abs(ahead):
            slip = float(np.abs(y[stop - 1 : until + 1] - y[stop - 1]).max())
            events.append(StickSlip(float(time[start]), float(x[start]), float(time[stop - 1] - time[start]), slip))
    return events


def _standing(y: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Samples (first, one after the last) of each longest stretch that stays within :data:`STANDING` of its start."""
    places = np.concatenate([[0], np.flatnonzero(np.diff(y)) + 1, [len(y)]]).tolist()
    levels = y[places[:-1]].tolist()
    stretches, start = [], 0
    for place, level in zip(places[:-1], levels, strict=True):
        if abs(level - y[start]) > STANDING:
            stretches.append((start, place))
            start = place
    stretches.append((start, len(y)))
    return stretches
