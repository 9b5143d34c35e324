"""The excitation of the loop: periods of a sum of sines on a grid of frequencies, repeated with other random phases.

Periodic signals have no leakage: the discrete Fourier transform over whole periods gives each line exactly. Each draw
of phases begins before its period, so that the transient dies in what is not used. Draws with other phases show what of
the response is not linear: a nonlinearity answers each draw with a part of its own that looks random, which a
repetition of the same period would not show (R. Pintelon and J. Schoukens, System Identification, 2nd ed., 2012,
chapter 4).

The amplitudes are shaped by what the description expects of the loop. At low frequencies a law takes back most of what
is added to its command: there the signal is larger, by a bounded factor, since the law's own command is limited too.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control import FrequencyResponseError
from straightcomp_ros.control.closed_form import LoopResponse
from straightcomp_ros.control.excitation_parameters import MultisineParameters

_HIGHEST_SHARE = 0.4
"""Highest line, relative to the sampling rate: above, the samples tell too little of the motion between them."""
_MOST = 3.0
"""Largest factor of the signal at low frequencies."""
_CROSSOVER = 0.5
"""Part of its lead over which a draw takes over from the one before."""


@dataclass(frozen=True, eq=False)
class Multisine:
    """An excitation at a sampling rate.

    Attributes:
        frequencies: (lines,) Hz, whole multiples of the period's inverse.
        bins: (lines,) these multiples.
        samples: of a period.
        lead: samples of a draw before its period, which are not used.
        draws: of phases, one after the other.
        currents: (draws · (lead + samples),) A.
    """

    frequencies: NDArray[np.float64]
    bins: NDArray[np.int64]
    samples: int
    lead: int
    draws: int
    currents: NDArray[np.float64]

    def used(self, series: NDArray[np.float64]) -> NDArray[np.float64]:
        """The period of each draw, (draws, samples), of a series (n,) that begins with the excitation."""
        each = self.lead + self.samples
        return series[: self.draws * each].reshape(self.draws, each)[:, self.lead :]


def multisine(
    parameters: MultisineParameters, rate: float, expected: Callable[[NDArray[np.float64]], LoopResponse]
) -> Multisine:
    """The excitation.

    Args:
        parameters: of it.
        rate: sampling rate, Hz.
        expected: the loop's responses at frequencies (lines,) in Hz, as far as known.

    Raises:
        FrequencyResponseError: the lowest frequency does not fit the period, or the highest one.
    """
    samples = round(parameters.period * rate)
    spacing = rate / samples
    highest = min(parameters.highest, _HIGHEST_SHARE * rate)
    if not spacing <= parameters.lowest < highest:
        raise FrequencyResponseError(
            f"lowest frequency {parameters.lowest:g} Hz with a period of {parameters.period:g} s; "
            f"allowed: >= {spacing:g} Hz and below the highest of {highest:g} Hz"
        )
    wanted = np.geomspace(parameters.lowest, highest, parameters.lines) / spacing
    bins = np.unique(np.round(wanted).astype(np.int64))
    random = np.random.default_rng(parameters.seed)
    frequencies = np.asarray(bins * spacing, dtype=np.float64)
    loop, share = expected(frequencies), np.sqrt(2.0 / bins.size)
    shape = np.minimum(1.0 / np.abs(loop.sensitivity), _MOST)
    shape *= parameters.current * share / np.sqrt(np.mean(shape**2))
    amplitudes = np.minimum(
        shape, parameters.motion * parameters.travel * share / np.abs(loop.plant * loop.sensitivity)
    )
    lead = round(parameters.lead * rate)
    parts, before = [], np.zeros(lead)
    # The draws cross over smoothly: where the law takes back most of the signal, a step of it would come through.
    new = 0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, np.arange(lead) / (_CROSSOVER * lead)))
    for _ in range(parameters.draws):
        spectrum = np.zeros(samples // 2 + 1, complex)
        spectrum[bins] = 0.5 * samples * amplitudes * np.exp(2j * np.pi * random.random(bins.size))
        once = np.fft.irfft(spectrum, samples)
        parts += [before + new * (once[samples - lead :] - before), once]
        # What would follow: the draw from its beginning.
        before = once[:lead]
    return Multisine(frequencies, bins, samples, lead, parameters.draws, np.concatenate(parts))
