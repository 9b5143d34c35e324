"""Margins of a loop from its frequency response at some frequencies, measured or computed.

Between two lines, logarithms of magnitude and phase run straight over the logarithm of the frequency. What lies beyond
the first and the last line is not known: a margin that would lie there is None.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ResponseMargins(NamedTuple):
    """Margins; None where the response does not reach that far, all of them without a response.

    Attributes:
        gain_low, gain_high: factors of the loop gain between which it stays stable.
        phase: smallest one over the gain crossovers, degrees.
        crossover: the highest gain crossover, Hz.
        delay: further delay of the commands up to which it stays stable, s.
        peak: of the sensitivity's magnitude.
        peak_frequency: there, Hz.
    """

    gain_low: float | None
    gain_high: float | None
    phase: float | None
    crossover: float | None
    delay: float | None
    peak: float | None
    peak_frequency: float | None

    def to_display(self) -> dict[str, Any]:
        """The margins with their units in the names."""
        return {
            "gain_low": self.gain_low,
            "gain_high": self.gain_high,
            "phase_deg": self.phase,
            "crossover_Hz": self.crossover,
            "delay_us": None if self.delay is None else self.delay * 1e6,
            "sensitivity_peak": self.peak,
            "sensitivity_peak_Hz": self.peak_frequency,
        }


def response_margins(frequencies: Array, open_loop: NDArray[np.complex128]) -> ResponseMargins:
    """Margins of a stable loop with ``open_loop`` at ``frequencies`` (lines,) in Hz, rising.

    Lines that are not finite are left out. Of a measured loop hand over its coherent lines only.
    """
    finite = np.isfinite(open_loop)
    frequencies, open_loop = frequencies[finite], open_loop[finite]
    if not frequencies.size:
        return ResponseMargins(None, None, None, None, None, None, None)
    log_f, log_gain = np.log(frequencies), np.log(np.abs(open_loop))
    # Phase of −L: zero on the negative real axis, where the critical point is.
    phase = np.unwrap(np.angle(-open_loop))
    turns = 2.0 * np.pi * np.arange(np.floor(phase.min() / (2.0 * np.pi)), np.ceil(phase.max() / (2.0 * np.pi)) + 1.0)
    gains = [-value for turn in turns for value in _at_zeros(phase - turn, log_gain)]
    at_one = _at_zeros(log_gain, phase)
    crossovers = np.exp(_at_zeros(log_gain, log_f)).tolist()
    distances = [float((angle + np.pi) % (2.0 * np.pi) - np.pi) for angle in at_one]
    # A delay turns L clockwise: on to the critical point by the angle ahead of it.
    delays = [(angle % (2.0 * np.pi)) / (2.0 * np.pi * f) for angle, f in zip(at_one, crossovers, strict=True)]
    sensitivity = 1.0 / np.abs(1.0 + open_loop)
    highest = int(sensitivity.argmax())
    return ResponseMargins(
        gain_low=max((float(np.exp(gain)) for gain in gains if gain < 0.0), default=None),
        gain_high=min((float(np.exp(gain)) for gain in gains if gain > 0.0), default=None),
        phase=min((float(np.degrees(abs(distance))) for distance in distances), default=None),
        crossover=max(crossovers, default=None),
        delay=min(delays, default=None),
        peak=float(sensitivity[highest]),
        peak_frequency=float(frequencies[highest]),
    )


def _at_zeros(values: Array, others: Array) -> list[float]:
    """``others`` at the zeros of ``values``, both straight between their points."""
    places = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    share = values[places] / (values[places] - values[places + 1])
    return [float(value) for value in others[places] + share * (others[places + 1] - others[places])]
