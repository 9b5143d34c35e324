"""Detects an oscillation: a strong line in the spectrum of the compensation error, held for longer than a transient.

Quantisation, slips of friction and the guide also move the platform. An oscillation of the loop differs from these:

- it is a line with most of the power above the lowest frequency; a slip has a broad spectrum;
- it lasts; the response to a slip decays within some tens of milliseconds;
- the reference does not ask for it: at the line's frequency the reference moves much less than the error.

Two scales see both kinds. Short segments follow a limit cycle of the loop whose amplitude and frequency change along
the stroke. Long ones resolve slow hunting, which short ones cannot tell from the guide's own motion.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray


class _Scale(NamedTuple):
    """Length in s of a segment, and the lowest frequency in Hz of a line that it is to resolve."""

    span: float
    lowest: float


_SCALES = (_Scale(0.25, 40.0), _Scale(1.0, 8.0))
"""Bins 4 Hz and 1 Hz apart; ten and eight periods of the slowest line."""
_HELD = 4
"""Consecutive segments, overlapping by half, in which the line must stand: 0.6 s, 2.5 s."""
_MOST = 0.5
"""Fraction of the power above the lowest frequency that makes a peak a line; white noise has a fiftieth of it there."""
_ASKED = 3.0
"""Factor by which the error must exceed the reference in the line. A loop with usual margins amplifies what its
reference asks for by less, at any frequency: the largest sensitivity of a modulus margin of 1/3."""
_DEVIATION = 0.004
"""Least amplitude of an oscillation relative to the uncompensated deviation, however fine the encoder: 0.09 µm on the
shipped guide, where noise and quantisation ring with less."""
_SHARE = 0.7
"""Least amplitude of an oscillation relative to the RMS of the error, a quarter of its power; a line alone has √2.
The law's usual error hides what is less."""
_LOBE = 2
"""Bins to each side of its peak into which the Hann window spreads a line."""
_HANN_BANDWIDTH = 1.5
"""Hann's equivalent noise bandwidth in bins: Σ of a line's squared bins by its squared amplitude (Harris, Proc. IEEE
66(1), 1978, table 1)."""


class Oscillation(NamedTuple):
    """The strongest held line: amplitude in m (0 if there is none), frequency in Hz."""

    amplitude: float
    frequency: float


def tolerated_amplitude(error: NDArray[np.float64], count: float, uncompensated: float) -> float:
    """Amplitude in m up to which a line in ``error`` is no oscillation of the loop.

    Args:
        error: (n,) in m.
        count: one count of the encoder, m.
        uncompensated: what a platform that stands still would leave, p-p in m.
    """
    return max(count, _DEVIATION * uncompensated, _SHARE * float(np.std(error)))


def sustained_oscillation(error: NDArray[np.float64], reference: NDArray[np.float64], period: float) -> Oscillation:
    """The strongest line that ``error`` holds on either scale, or throughout if it is shorter.

    Its amplitude is the smallest over its segments. An ``error`` shorter than a segment (0.25 s) has none.

    Args:
        error: (n,) finite, in m.
        reference: (n,) what the platform was to follow at the same samples, in m.
        period: sampling period in s.
    """
    return max(_held_line(error, reference, period, scale) for scale in _SCALES)


def irregular_oscillation(error: NDArray[np.float64], reference: NDArray[np.float64], period: float) -> Oscillation:
    """What ``error`` does beyond what ``reference`` asks for, if that is most of it, whether it is a line or not.

    For an error that is known to be large: a loop that reaches the current limit changes its frequency from one moment
    to the next. The amplitude is that of a sine of the same RMS, the frequency that of the strongest line. Arguments as
    of :func:`sustained_oscillation`.
    """
    scale = _SCALES[-1]
    length = round(scale.span / period)
    if error.size < length:
        return Oscillation(0.0, 0.0)
    power, asked = (_power(values, length).mean(axis=0) for values in (error, reference))
    own = np.where(power > _ASKED**2 * asked, power, 0.0)
    # The first bins hold the window's own lobe around the mean.
    own[: _LOBE + 1] = 0.0
    if own.sum() < _MOST * power.sum():
        return Oscillation(0.0, 0.0)
    frequencies = np.fft.rfftfreq(length, period)
    return Oscillation(float(np.sqrt(own.sum() / _HANN_BANDWIDTH)), float(frequencies[own.argmax()]))


def _held_line(error: NDArray[np.float64], reference: NDArray[np.float64], period: float, scale: _Scale) -> Oscillation:
    length = round(scale.span / period)
    if error.size < length:
        return Oscillation(0.0, 0.0)
    frequencies = np.fft.rfftfreq(length, period)
    power, asked = (_power(values, length) for values in (error, reference))
    power[:, frequencies < scale.lowest] = 0.0
    peaks = power.argmax(axis=1)
    near = np.abs(np.arange(frequencies.size) - peaks[:, np.newaxis]) <= _LOBE
    own = np.where(near, power, 0.0)
    line, there = own.sum(axis=1), np.where(near, asked, 0.0).sum(axis=1)
    found = (line > _MOST * power.sum(axis=1)) & (line > _ASKED**2 * there)
    amplitudes = np.where(found, np.sqrt(line / _HANN_BANDWIDTH), 0.0)
    held = sliding_window_view(amplitudes, min(_HELD, amplitudes.size)).min(axis=1)
    at = int(held.argmax())
    if held[at] == 0.0:
        return Oscillation(0.0, 0.0)
    return Oscillation(float(held[at]), float(own[at] @ frequencies / line[at]))


def _power(values: NDArray[np.float64], length: int) -> NDArray[np.float64]:
    """Squared amplitude of each bin in each segment, (segments, bins) in m²; segments overlap by half."""
    segments = sliding_window_view(values, length)[:: length // 2]
    window = np.hanning(length)
    spectra = np.fft.rfft((segments - segments.mean(axis=1, keepdims=True)) * window, axis=1)
    return np.asarray(np.abs(spectra * (2.0 / window.sum())) ** 2)
