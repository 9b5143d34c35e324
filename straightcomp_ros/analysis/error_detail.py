"""The compensation error of a run in more detail: its spectrum, stick-slip of the platform, an oscillation of the loop.

In stick-slip the platform stands while its reference moves on, then jumps after it. An oscillation is a strong line in
the spectrum, held for longer than a transient. Quantisation, slips of friction and the guide also move the platform; an
oscillation of the loop differs from these:

- it is a line with most of the power above the lowest frequency; a slip has a broad spectrum;
- it lasts; the response to a slip decays within some tens of milliseconds;
- the reference does not ask for it: at the line's frequency the reference moves much less than the error.

Two scales see both kinds. Short segments follow a limit cycle of the loop whose amplitude and frequency change along
the stroke. Long ones resolve slow hunting, which short ones cannot distinguish from the guide's own motion.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import Array

BANDS = ((0.0, 10.0), (10.0, 100.0), (100.0, 1000.0))
"""Bands in Hz of the reported errors: map and friction, the loop's own bandwidth, noise and chatter."""
SEGMENT = 1.0
"""Length in s of the segments that are averaged: lines 1 Hz apart."""
_LEAST_SAMPLES = 16
"""Fewer have no spectrum."""
FILLED = 0.02
"""Gap in s that may be interpolated: two periods of the highest frequency, 100 Hz, that a loop of this kind follows."""
STUCK, STUCK_COUNTS = 0.4e-6, 4.0
"""Way by which the reference runs on while the platform stands, that makes a stick: the larger one, in m and in counts
of the encoder."""
STANDING, STANDING_COUNTS = 0.15e-6, 1.5
"""Distance within which the platform counts as standing, likewise: one count to and fro."""
SLIP_TIME = 0.02
"""Time in s after a stick within which the platform must have jumped."""
SLIP = 0.5
"""Part of the stick that the platform makes good in that time, beyond the reference's own motion."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One-sided power spectral density: frequency (m,) in Hz, density (m,) in m²/Hz; empty for too few samples."""

    frequency: Array
    density: Array

    def band_rms(self, low: float, high: float) -> float:
        """RMS in m of the band from ``low`` (inclusive) to ``high`` Hz; NaN for an empty spectrum."""
        if not len(self.density):
            return math.nan
        inside = (self.frequency >= low) & (self.frequency < high)
        step = self.frequency[1] - self.frequency[0] if len(self.frequency) > 1 else 0.0
        return float(np.sqrt(self.density[inside].sum() * step))


def error_spectrum(time: Array, error: Array) -> Spectrum:
    """Spectrum by Welch's method: segments of :data:`SEGMENT` that overlap by half, Hann window, mean removed.

    ``error`` (n,) in m at ``time`` (n,) in s, rising, is interpolated over short gaps; the spectra of the
    :func:`stretches` between longer ones are averaged, each by its length.
    Source: P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70–73.
    """
    period = float(np.median(np.diff(time))) if len(time) > 1 else math.nan
    pieces = [values for (values,) in stretches(time, error) if len(values) >= _LEAST_SAMPLES]
    if not pieces:
        return Spectrum(np.empty(0), np.empty(0))
    length = min(round(SEGMENT / period), max(map(len, pieces)))
    whole = [values for values in pieces if len(values) >= length]
    # scipy.signal does the same, but its import takes longer than all that a bag's evaluation computes.
    window = np.hanning(length + 1)[:-1]
    step = length - length // 2
    segments = [sliding_window_view(values, length)[::step] for values in whole]
    powers = [np.abs(_transforms(one, window)) ** 2 for one in segments]
    density = np.average([power.mean(axis=0) for power in powers], axis=0, weights=[len(values) for values in whole])
    density *= period / float(window @ window)
    # One-sided: all but the mean and, of an even length, the highest frequency stand for two.
    density[1 : (length + 1) // 2] *= 2.0
    return Spectrum(np.arange(density.size) / (length * period), density)


def _transforms(segments: Array, window: Array) -> NDArray[np.complex128]:
    """Fourier transforms (m, k) of the segments (m, n), each without its mean, under the window (n,)."""
    return np.asarray(np.fft.rfft((segments - segments.mean(axis=1, keepdims=True)) * window, axis=1), np.complex128)


def stretches(time: Array, *columns: Array) -> Iterator[tuple[Array, ...]]:
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


def stick_slips(time: Array, x: Array, y: Array, r: Array, count: float = 0.0) -> list[StickSlip]:
    """The events in one stroke; all arrays (n,), in s and m, as the encoders see them. ``count`` is that of the encoder
    of y in m; 0: not known."""
    events, stuck = [], max(STUCK, STUCK_COUNTS * count)
    for start, stop in _standing(y, max(STANDING, STANDING_COUNTS * count)):
        last = stop - 1
        ahead = r[last] - r[start]
        if abs(ahead) < stuck:
            continue
        after = slice(last, int(np.searchsorted(time, time[last] + SLIP_TIME)) + 1)
        moved = y[after] - y[last]
        gained = np.sign(ahead) * (moved - (r[after] - r[last]))
        if gained.max() >= SLIP * abs(ahead):
            slip = float(np.abs(moved).max())
            events.append(StickSlip(float(time[start]), float(x[start]), float(time[last] - time[start]), slip))
    return events


def _standing(y: Array, within: float) -> list[tuple[int, int]]:
    """Samples (first, one after the last) of each longest stretch that stays ``within`` m of its start."""
    stretches, start = [], 0
    for place in (np.flatnonzero(np.diff(y)) + 1).tolist():
        if abs(y[place] - y[start]) > within:
            stretches.append((start, place))
            start = place
    return [*stretches, (start, len(y))]


_SCALES = ((0.25, 40.0), (1.0, 8.0))
"""Length in s of a segment, and the lowest frequency in Hz of a line that it is to resolve: ten and eight periods."""
_HELD = 4
"""Consecutive segments, overlapping by half, in which the line must stand: 0.6 s, 2.5 s."""
_MOST = 0.5
"""Fraction of the power above the lowest frequency that makes a peak a line; white noise has a fiftieth of it there."""
ASKED = 3.0
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


def tolerated_amplitude(error: Array, count: float, uncompensated: float) -> float:
    """Amplitude in m up to which a line in ``error`` (n,) is no oscillation of the loop; ``count`` is that of the
    encoder, ``uncompensated`` what a platform that stands still would leave, p-p, all in m."""
    return max(count, _DEVIATION * uncompensated, _SHARE * float(np.std(error)))


def sustained_oscillation(error: Array, reference: Array, period: float, dither: float = 0.0) -> Oscillation:
    """The strongest line that ``error`` holds on either scale, or throughout if it is shorter.

    Its amplitude is the smallest over its segments. An ``error`` shorter than a segment (0.25 s) has none. ``error``
    and ``reference``, what the platform was to follow at the same samples, are (n,), finite, in m; ``period`` is that
    of the samples in s. A line at the frequency of the law's own ``dither`` in Hz is none; 0: there is no dither.
    """
    return max(_held_line(error, reference, period, dither, *scale) for scale in _SCALES)


def irregular_oscillation(error: Array, reference: Array, period: float, dither: float = 0.0) -> Oscillation:
    """What ``error`` does beyond what ``reference`` asks for, if that is most of it, whether it is a line or not.

    For an error that is known to be large: a loop that reaches the current limit changes its frequency from one moment
    to the next. The amplitude is that of a sine of the same RMS, the frequency that of the strongest line. Arguments as
    of :func:`sustained_oscillation`.
    """
    length = round(_SCALES[-1][0] / period)
    if error.size < length:
        return Oscillation(0.0, 0.0)
    power, asked = (_power(values, length).mean(axis=0) for values in (error, reference))
    frequencies = np.fft.rfftfreq(length, period)
    power[_shaken(frequencies, dither)] = 0.0
    own = np.where(power > ASKED**2 * asked, power, 0.0)
    # The first bins hold the window's own lobe around the mean.
    own[: _LOBE + 1] = 0.0
    if own.sum() < _MOST * power.sum():
        return Oscillation(0.0, 0.0)
    return Oscillation(float(np.sqrt(own.sum() / _HANN_BANDWIDTH)), float(frequencies[own.argmax()]))


def _shaken(frequencies: NDArray[Any], dither: float) -> NDArray[np.bool_]:
    """Which bins hold the dither's line; none where it is 0."""
    return np.asarray((np.abs(frequencies - dither) <= _LOBE * frequencies[1]) & (dither > 0.0))


def _held_line(error: Array, reference: Array, period: float, dither: float, span: float, lowest: float) -> Oscillation:
    length = round(span / period)
    if error.size < length:
        return Oscillation(0.0, 0.0)
    frequencies = np.fft.rfftfreq(length, period)
    power, asked = (_power(values, length) for values in (error, reference))
    power[:, (frequencies < lowest) | _shaken(frequencies, dither)] = 0.0
    near = np.abs(np.arange(frequencies.size) - power.argmax(axis=1)[:, np.newaxis]) <= _LOBE
    own = np.where(near, power, 0.0)
    line, there = own.sum(axis=1), np.where(near, asked, 0.0).sum(axis=1)
    found = (line > _MOST * power.sum(axis=1)) & (line > ASKED**2 * there)
    amplitudes = np.where(found, np.sqrt(line / _HANN_BANDWIDTH), 0.0)
    together = sliding_window_view(amplitudes, min(_HELD, amplitudes.size))
    first = int(together.min(axis=1).argmax())
    amplitude = float(together[first].min())
    if not amplitude:
        return Oscillation(0.0, 0.0)
    # A transient in one of the segments has a frequency of its own.
    segments = slice(first, first + together.shape[1])
    return Oscillation(amplitude, float(np.median(own[segments] @ frequencies / line[segments])))


def _power(values: Array, length: int) -> Array:
    """Squared amplitude of each bin in each segment, (segments, bins) in m²; segments overlap by half."""
    segments = sliding_window_view(values, length)[:: length // 2]
    window = np.hanning(length)
    spectra = _transforms(segments, window)
    return np.asarray(np.abs(spectra * (2.0 / window.sum())) ** 2)
