"""Spectrum of the compensation error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BANDS = ((0.0, 10.0), (10.0, 100.0), (100.0, 1000.0))
"""Bands in Hz whose share of the error is told: map and friction, the loop's own bandwidth, noise and chatter."""
SEGMENT = 1.0
"""Length in s of the pieces that are averaged: lines 1 Hz apart."""
_PEAKS = 5


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One-sided power spectral density.

    Attributes:
        frequency: (m,) Hz.
        density: (m,) m²/Hz.
    """

    frequency: NDArray[np.float64]
    density: NDArray[np.float64]

    def band_rms(self, low: float, high: float) -> float:
        """RMS in m of the part from ``low`` (inclusive) to ``high`` Hz."""
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
    """Spectrum by Welch's method: pieces of :data:`SEGMENT` half over each other, Hann window, mean removed.

    Args:
        time: (n,) s, rising; where samples are missing the error is interpolated.
        error: (n,) m.

    Source: P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70–73.
    """
    if len(time) < 16:
        return Spectrum(np.empty(0), np.empty(0))
    # Its import takes half a second: only who makes a spectrum pays for it.
    from scipy.signal import welch

    period = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1] + 0.5 * period, period)
    values = np.interp(grid, time, error)
    return Spectrum(*welch(values, 1.0 / period, nperseg=min(round(SEGMENT / period), len(grid))))
