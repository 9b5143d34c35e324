"""Whether the loop oscillates by itself: a strong line, held for longer than a transient, in the true error.

A loop with a coarse encoder is never quite at rest, friction lets it slip now and then, and the guide moves it along.
A limit cycle differs from each of these:

- it is larger than a count of the encoder, within which no loop can hold itself;
- it is a line, where a slip has a broad spectrum: most of the power above the lowest frequency lies in it;
- it lasts, where the answer to a slip dies away within some tens of milliseconds;
- it lies at the loop's own frequency, above what the map asks for at the stage's speed.

Where this finds one, the loop is at the edge of its own oscillation or beyond it: about one count is where the ring of
a loop that noise and quantisation keep exciting ends, and an oscillation that feeds itself begins.

Slow hunting below that frequency is not looked for: it shows in the peak-to-peak error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

LOWEST_FREQUENCY = 40.0
"""Hz; a survey every 10 mm asks for 15 Hz at most at 0.3 m/s, and no loop of this machine crosses over below 60 Hz."""
LEAST_AMPLITUDE = 0.1e-6
"""m; an oscillation below this is none, however fine the encoder is."""
_SPAN = 0.25
"""Length in s of a piece that is looked at: lines 4 Hz apart."""
_HELD = 4
"""Pieces in a row, each half over the one before, in which the line must stand: 0.6 s."""
_MOST = 0.5
"""Part of the power above the lowest frequency that makes a peak a line; white noise has a fiftieth of it there."""
_LOBE = 2
"""Bins to each side of its peak into which the Hann window spreads a line."""
_HANN_BANDWIDTH = 1.5
"""Σ of the squared bins of a line by its squared amplitude: Hann's equivalent noise bandwidth in bins (Harris, Proc.
IEEE 66(1), 1978, table 1)."""


class Oscillation(NamedTuple):
    """The strongest line that is held: amplitude in m (0 if there is none), frequency in Hz."""

    amplitude: float
    frequency: float


def sustained_oscillation(error: NDArray[np.float64], period: float, lowest: float = LOWEST_FREQUENCY) -> Oscillation:
    """The strongest line that stands in ``error`` for 0.6 s, or all along if that is shorter.

    Its amplitude is the smallest of the pieces that it is held in; one shorter than a piece (0.25 s) shows none.

    Args:
        error: (n,) finite, in m.
        period: sampling period in s.
        lowest: lowest frequency that is looked at, Hz.
    """
    length = round(_SPAN / period)
    if error.size < length:
        return Oscillation(0.0, 0.0)
    pieces = sliding_window_view(error, length)[:: length // 2]
    window = np.hanning(length)
    spectra = np.fft.rfft((pieces - pieces.mean(axis=1, keepdims=True)) * window, axis=1)
    power = np.abs(spectra * (2.0 / window.sum())) ** 2
    frequencies = np.fft.rfftfreq(length, period)
    power[:, frequencies < lowest] = 0.0

    peaks = power.argmax(axis=1)
    near = np.abs(np.arange(frequencies.size) - peaks[:, np.newaxis]) <= _LOBE
    line = np.where(near, power, 0.0).sum(axis=1)
    amplitudes = np.where(line > _MOST * power.sum(axis=1), np.sqrt(line / _HANN_BANDWIDTH), 0.0)
    held = sliding_window_view(amplitudes, min(_HELD, amplitudes.size)).min(axis=1)
    at = int(held.argmax())
    if held[at] == 0.0:
        return Oscillation(0.0, 0.0)
    return Oscillation(float(held[at]), float(frequencies[peaks[at]]))
