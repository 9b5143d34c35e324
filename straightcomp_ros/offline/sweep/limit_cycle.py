"""Detects a limit cycle: a strong line in the spectrum of the true error, held for longer than a transient.

Quantisation, slips of friction and the guide also move the platform. A limit cycle differs from these:

- its amplitude is above one count of the encoder, about where ringing that noise and quantisation excite ends and
  self-excited oscillation begins;
- it is a line with most of the power above the lowest frequency; a slip has a broad spectrum;
- it lasts; the response to a slip decays within some tens of milliseconds;
- its frequency is the loop's own, above those of the map at the stage's speed.

Slow hunting below that frequency is not detected: it shows in the peak-to-peak error.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

LOWEST_FREQUENCY = 40.0
"""Hz; at 0.3 m/s a survey every 10 mm has up to 15 Hz; no loop of this machine crosses over below 60 Hz."""
LEAST_AMPLITUDE = 0.1e-6
"""Smallest amplitude in m of a limit cycle, however fine the encoder is."""
_SPAN = 0.25
"""Length in s of a segment: bins 4 Hz apart."""
_HELD = 4
"""Consecutive segments, overlapping by half, in which the line must stand: 0.6 s."""
_MOST = 0.5
"""Fraction of the power above the lowest frequency that makes a peak a line; white noise has a fiftieth of it there."""
_LOBE = 2
"""Bins to each side of its peak into which the Hann window spreads a line."""
_HANN_BANDWIDTH = 1.5
"""Hann's equivalent noise bandwidth in bins: Σ of a line's squared bins by its squared amplitude (Harris, Proc. IEEE
66(1), 1978, table 1)."""


class Oscillation(NamedTuple):
    """The strongest held line: amplitude in m (0 if there is none), frequency in Hz."""

    amplitude: float
    frequency: float


def sustained_oscillation(error: NDArray[np.float64], period: float, lowest: float = LOWEST_FREQUENCY) -> Oscillation:
    """The strongest line that stands in ``error`` for 0.6 s, or throughout if that is shorter.

    Its amplitude is the smallest over its segments. An ``error`` shorter than a segment (0.25 s) has none.

    Args:
        error: (n,) finite, in m.
        period: sampling period in s.
        lowest: lowest frequency in Hz.
    """
    length = round(_SPAN / period)
    if error.size < length:
        return Oscillation(0.0, 0.0)
    segments = sliding_window_view(error, length)[:: length // 2]
    window = np.hanning(length)
    spectra = np.fft.rfft((segments - segments.mean(axis=1, keepdims=True)) * window, axis=1)
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
