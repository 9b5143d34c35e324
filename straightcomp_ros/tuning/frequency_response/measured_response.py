"""Responses from a record of the excited loop, with coherence and confidence.

The signal d is known and periodic, so that the responses from it have no bias by noise in the loop, which those from
command to reading would have:

    P = (Y/D) / (U/D),   S = U/D,   L = 1/S − 1,

each a mean over the draws of phases. How the draws differ tells the noise, and what friction and other nonlinearities
add (R. Pintelon and J. Schoukens, System Identification, 2nd ed., 2012, sections 2.7 and 4.3).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from straightcomp_ros.control.excitation import Multisine
from straightcomp_ros.control.margins import LoopResponse

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class MeasuredResponse:
    """Responses at the lines of an excitation.

    Attributes:
        frequencies: (lines,) Hz.
        response: plant, open loop and sensitivity.
        coherence: (lines,) of the plant's response: the lesser one of signal with reading and signal with command.
        plant_radius, open_loop_radius, sensitivity_radius: (lines,) of the circles in the complex plane that hold the
            true values with a confidence of 95 %, in the responses' units.
        speed: RMS velocity of the platform at the lines, m/s.
        draws: of phases, which the circles are from.
    """

    frequencies: Array
    response: LoopResponse
    coherence: Array
    plant_radius: Array
    open_loop_radius: Array
    sensitivity_radius: Array
    speed: float
    draws: int

    @property
    def coherent(self) -> NDArray[np.bool_]:
        """(lines,) Where the coherence is above 0.9."""
        return self.coherence > 0.9

    @property
    def jointly(self) -> float:
        """Factor by which the circles must grow so that those of all coherent lines hold at once with 95 %.

        Each line then has the confidence 0.95^(1/n) of Z. Šidák, Journal of the American Statistical Association, 1967.
        Of n lines with 95 % each, one in twenty is outside by chance.
        """
        each = _CONFIDENCE ** (1.0 / max(1, int(self.coherent.sum())))
        return _radius_factor(each, self.draws) / _radius_factor(_CONFIDENCE, self.draws)


def measured_response(excitation: Multisine, signal: Array, command: Array, reading: Array) -> MeasuredResponse:
    """Responses from series (n,) that begin with the excitation.

    Args:
        excitation: what was injected.
        signal: what the injection truly added to the command, A; differs from the excitation where it was limited.
        command: with it, A.
        reading: y, m.
    """
    d, u, y = (_lines(excitation, series) for series in (signal, command, reading))
    per_u, per_y = u / d, y / d
    sensitivity, output = per_u.mean(axis=0), per_y.mean(axis=0)
    plant = output / sensitivity
    draws = len(d)
    factor = _radius_factor(_CONFIDENCE, draws)

    def radius(residuals: Complex) -> Array:
        return np.asarray(factor * np.sqrt((np.abs(residuals) ** 2).sum(axis=0)))

    sensitivity_radius = radius(per_u - sensitivity)
    return MeasuredResponse(
        frequencies=excitation.frequencies,
        response=LoopResponse(plant, 1.0 / sensitivity - 1.0, sensitivity),
        coherence=np.minimum(_coherence(d, y), _coherence(d, u)),
        plant_radius=radius(per_y - plant * per_u) / np.abs(sensitivity),
        # L + 1 = 1/S, so dL = −dS/S².
        open_loop_radius=sensitivity_radius / np.abs(sensitivity) ** 2,
        sensitivity_radius=sensitivity_radius,
        speed=float(np.sqrt(0.5 * np.mean(np.sum(np.abs(2.0 * np.pi * excitation.frequencies * y) ** 2, axis=1)))),
        draws=draws,
    )


def _radius_factor(confidence: float, draws: int) -> float:
    """Radius of the circle of a complex mean over few draws, relative to the root of its residuals' sum of squares."""
    return math.sqrt(float(fisher.ppf(confidence, 2, 2 * (draws - 1))) / (draws * (draws - 1)))


def _lines(excitation: Multisine, series: Array) -> Complex:
    """Complex amplitudes (draws, lines) at the excitation's lines."""
    spectrum = np.fft.rfft(excitation.used(series), axis=1) / (0.5 * excitation.samples)
    return np.asarray(spectrum[:, excitation.bins])


def _coherence(one: Complex, other: Complex) -> Array:
    """(lines,) squared coherence over the draws; 0 where either is silent."""
    common = np.abs((other * one.conj()).sum(axis=0)) ** 2
    powers = (np.abs(one) ** 2).sum(axis=0) * (np.abs(other) ** 2).sum(axis=0)
    return np.asarray(np.divide(common, powers, out=np.zeros_like(common), where=powers > 0.0))
