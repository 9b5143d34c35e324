"""The compensation error of a run in more detail: its spectrum, and the stick-slip of the platform.

In stick-slip the platform stands while its reference moves on, then jumps after it.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BANDS = ((0.0, 10.0), (10.0, 100.0), (100.0, 1000.0))
"""Bands in Hz of the reported errors: map and friction, the loop's own bandwidth, noise and chatter."""
SEGMENT = 1.0
"""Length in s of the segments that are averaged: lines 1 Hz apart."""
_PEAKS = 5
_LEAST_SAMPLES = 16
"""Fewer have no spectrum."""
FILLED = 0.02
"""Gap in s that may be interpolated: two periods of the highest frequency, 100 Hz, that a loop of this kind follows."""
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

    ``error`` (n,) in m at ``time`` (n,) in s, rising, is interpolated over short gaps; the spectra of the
    :func:`stretches` between longer ones are averaged, each by its length.
    Source: P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70–73.
    """
    period = float(np.median(np.diff(time))) if len(time) > 1 else math.nan
    pieces = [values for (values,) in stretches(time, error) if len(values) >= _LEAST_SAMPLES]
    if not pieces:
        return Spectrum(np.empty(0), np.empty(0))
    # This import takes half a second.
    from scipy.signal import welch

    length = min(round(SEGMENT / period), max(map(len, pieces)))
    whole = [values for values in pieces if len(values) >= length]
    spectra = [welch(values, 1.0 / period, nperseg=length) for values in whole]
    density = np.average([found for _, found in spectra], axis=0, weights=[len(values) for values in whole])
    return Spectrum(spectra[0][0], density)


def stretches(time: NDArray[np.float64], *columns: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.float64], ...]]:
    """The ``columns`` (n,) of each stretch of ``time`` (n,) in s without a gap of more than :data:`FILLED`, on its even
    grid: single samples that are missing are interpolated, a pause of the recording never."""
    steps = np.diff(time)
    period = float(np.median(steps))
    longest = max(FILLED, 1.5 * period)
    edges = np.concatenate([[0], np.flatnonzero(steps > longest) + 1, [len(time)]])
    for first, end in itertools.pairwise(edges.tolist()):
        part = time[first:end]
        if len(part) > 1 and float(np.diff(part).max()) >= 1.5 * period:
            grid = np.arange(part[0], part[-1] + 0.5 * period, period)
            yield tuple(np.interp(grid, part, column[first:end]) for column in columns)
        else:
            yield tuple(column[first:end] for column in columns)


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
