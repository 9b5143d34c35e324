"""A start for the search, from the equation of motion while the platform slides: linear in what it tells.

    ÿ = (K̄_i/M) i_c + (K̄_y/M) y − (F_C/M) sgn ẏ − (σ2/M) ẏ + c

All signals pass the same polynomial filter (Savitzky and Golay, Analytical Chemistry 36(8), 1964), so that it distorts
none against another, and samples near a reversal are left out, where the bristles matter. The ratio K̄_i/K̄_y = y0/I0
gives the air gap, whatever the mass. The search begins here too, since from a description that is far off it may end in
a wrong valley. The constant tells the centre, where the magnets balance: y_c = −c M/K̄_y.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.signal import savgol_filter

from straightcomp_ros.analysis.current_path import Recording
from straightcomp_ros.model.actuator import MU_0
from straightcomp_ros.tuning.identification.block_covariance import BLOCK, block_covariance
from straightcomp_ros.tuning.identification.unknowns import NAMES, Unknowns

Array = NDArray[np.float64]

_WINDOW = 0.01
"""s; of the filter: far longer than a sample, shorter than the quick waves of an excitation."""
_ORDER = 3
_SLIDING = 2e-4
"""m/s; ten times the Stribeck velocity of the shipped stage."""
_LEAST = 500
"""Samples of sliding."""
_TWO_SIDED, _CERTAIN = 2.0, 5.0
"""Standard deviations of a 95 % interval, of some tens of blocks, and of what is beyond doubt."""
_LEAST_VISCOUS = 0.1
"""N·s/m; where there is hardly any, it may come out negative, which has no logarithm."""


@dataclass(frozen=True)
class Centre:
    """Where the magnets balance without a control current, and its standard deviation, m."""

    value: float
    deviation: float

    @property
    def certain(self) -> bool:
        """Whether it is certainly not the encoder's zero."""
        return abs(self.value) > _CERTAIN * self.deviation

    def to_display(self) -> dict[str, float]:
        """In µm, with its 95 % interval."""
        half = _TWO_SIDED * self.deviation
        bounds = {"value": self.value, "low": self.value - half, "high": self.value + half}
        return {name: one * 1e6 for name, one in bounds.items()}

    def __str__(self) -> str:
        shown = self.to_display()
        return (
            f"the magnets balance at y = {shown['value']:.3g} µm (95 %: {shown['low']:.3g} to {shown['high']:.3g} µm)"
        )


def centre(recording: Recording) -> Centre | None:
    """The centre of the magnets; None where the record has too little sliding, or no stiffness that could tell it.

    A readback with an offset looks the same: the centre is that of the measured current.
    """
    found = _sliding(recording)
    if found is None or found.slopes[1] <= 0.0:
        return None
    _, stiffness, _, _, constant = found.slopes.tolist()
    value = -constant / stiffness
    # Of y_c = −c/b to first order in both.
    by_slopes = np.array([0.0, -value / stiffness, 0.0, 0.0, -1.0 / stiffness])
    return Centre(value, math.sqrt(float(by_slopes @ found.covariance @ by_slopes)))


def sliding_start(recording: Recording, unknowns: Unknowns) -> Array | None:
    """The unknowns' vector (9,) with what sliding tells; only free elements differ from the start of ``unknowns``.

    None where the record has too little sliding, or a stiffness or friction comes out negative.
    """
    found = _sliding(recording)
    if found is None or (slopes := found.slopes)[:3].min() <= 0.0:
        return None
    current_gain, position_gain, coulomb, viscous = slopes[:4].tolist()
    values = dict(zip(NAMES, np.exp(unknowns.start).tolist(), strict=True))
    free = {NAMES[place] for place in unknowns.free}
    if "actuator.air_gap" in free:
        values["actuator.air_gap"] = unknowns.bias_current * current_gain / position_gain
    # K̄_i / N², from (3)
    per_turns = MU_0 * unknowns.pole_area * unknowns.bias_current / values["actuator.air_gap"] ** 2
    if "platform.mass" in free:
        values["platform.mass"] = per_turns * values["actuator.turns"] ** 2 / current_gain
    if "actuator.turns" in free:
        values["actuator.turns"] = math.sqrt(current_gain * values["platform.mass"] / per_turns)
    if "friction.coulomb" in free:
        values["friction.coulomb"] = coulomb * values["platform.mass"]
    if "friction.viscous" in free:
        values["friction.viscous"] = max(_LEAST_VISCOUS, viscous * values["platform.mass"])
    vector = np.log([values[name] for name in NAMES])
    return np.asarray(np.clip(vector, unknowns.low, unknowns.high))


class _Sliding(NamedTuple):
    """K̄_i/M, K̄_y/M, F_C/M, σ2/M and c in SI units (5,), and their covariance (5, 5)."""

    slopes: Array
    covariance: Array


def _sliding(recording: Recording) -> _Sliding | None:
    """What sliding tells; None if there is too little."""
    period = recording.period_ns * 1e-9
    window = max(_ORDER + 2, 2 * round(0.5 * _WINDOW / period) + 1)

    def filtered(values: Array, derivative: int = 0) -> Array:
        return np.asarray(savgol_filter(values, window, _ORDER, deriv=derivative, delta=period))

    velocity = filtered(recording.y, 1)
    direction = np.sign(velocity)
    sliding = minimum_filter1d(np.abs(velocity), window) > _SLIDING
    # At its ends the filter extrapolates.
    sliding[:window] = sliding[-window:] = False
    if np.count_nonzero(sliding) < _LEAST:
        return None
    signals = (filtered(recording.current), filtered(recording.y), -direction, -velocity, np.ones_like(velocity))
    terms, wanted = np.stack(signals, axis=1)[sliding], filtered(recording.y, 2)[sliding]
    slopes, *_ = np.linalg.lstsq(terms, wanted, rcond=None)
    block = max(1, round(BLOCK / period))
    return _Sliding(np.asarray(slopes), block_covariance(terms, wanted - terms @ slopes, block))
