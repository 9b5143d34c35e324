"""The parameters to identify, as a vector of logarithms with its bounds, and where the search for them begins.

It begins at the description, and where the equation of motion leads while the platform slides. This one is linear in
what it identifies:

    ÿ = (K̄_i/M) i_c + (K̄_y/M) y − (F_C/M) sgn ẏ − (σ2/M) ẏ + c

All signals pass the same polynomial filter (Savitzky and Golay, Analytical Chemistry 36(8), 1964), so that it distorts
none against another, and samples near a reversal are left out, where the bristles matter. The ratio K̄_i/K̄_y = y0/I0
gives the air gap, whatever the mass. From a description that is far off the search may end in a wrong valley, from here
it does not. The constant gives the centre, where the magnets balance: y_c = −c M/K̄_y.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.signal import savgol_filter

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.current_path import Recording
from straightcomp_ros.model.actuator import MU_0, Actuator
from straightcomp_ros.model.friction import LuGre
from straightcomp_ros.model.plant import Plant, substep_for
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.stage.description import StageParameters

Array = NDArray[np.float64]

RATIO = "static_ratio"
"""F_S/F_C replaces F_S in the vector, so that F_S ≥ F_C is a simple bound."""
NAMES = (
    "platform.mass",
    "actuator.turns",
    "actuator.air_gap",
    "friction.coulomb",
    RATIO,
    "friction.stribeck_velocity",
    "friction.bristle_stiffness",
    "friction.bristle_damping",
    "friction.viscous",
)
"""Order of the vector; dotted names as below ``stage.``."""
FORCE_SCALE = ("platform.mass", "actuator.turns")
"""At least one of these must be known: position and current determine all forces only up to a common factor."""
_STOP = 0.9
"""Stop as a fraction of the air gap; the platform stays far from it."""
_DRY = NAMES[3:8]
"""Those of dry friction: held where the description has none. A record has none of it then, and would leave them open,
and the mass with them."""
_SMALLEST = {"friction.bristle_damping": 1.0, "friction.viscous": 0.1}
"""Least start of what is searched and may be zero, or come out negative where there is hardly any: neither has a
logarithm."""
_REACH = math.log(100.0)
BLOCK = 0.25
"""Length in s of the blocks that count as independent: quantisation errors are correlated over some 0.1 s."""
_WINDOW = 0.01
"""s; of the filter: far longer than a sample, shorter than the quick waves of an excitation."""
_ORDER = 3
_SLIDING = 2e-4
"""m/s; ten times the Stribeck velocity of the shipped stage."""
_SLOW = 3.0
"""Stribeck velocities from which a slower record slides: by Stribeck's law only exp(-9) of F_S - F_C is left there."""
_LEAST, _SAMPLES = 0.25, 500
"""s of sliding, or samples if those are sooner."""
_TWO_SIDED, _CERTAIN = 2.0, 5.0
"""Standard deviations of a 95 % interval, of some tens of blocks, and of what is beyond doubt."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Start and bounds of the search."""

    start: Array  # (9,) natural logarithms of the values of NAMES in SI units, as the bounds
    low: Array
    high: Array
    free: list[int]  # indices of the unknown elements
    stage: StageParameters  # its pole area, bias current and flexure are taken as given

    def constants(self, vector: Array, rate: float) -> Array:
        """The plant's constants (43,) for `plant.advance`, from (9,) logarithms and the amplifier's rate in rad/s."""
        mass, turns, gap, coulomb, ratio, stribeck, stiffness, damping, viscous = np.exp(vector).tolist()
        platform, given = self.stage.platform, self.stage.actuator
        actuator = Actuator(MU_0 * turns * turns * given.pole_area / 4.0, gap, given.bias_current)
        lugre = LuGre(coulomb, coulomb * ratio, stribeck, stiffness, damping, viscous)
        flexure = platform.stiffness, platform.damping
        substep = substep_for(mass, lugre, *flexure)
        return Plant(mass, _STOP * gap, rate, actuator, lugre, *flexure, substep).as_array()


def unknowns(stage: StageParameters, known: Sequence[str]) -> Unknowns:
    """The search that starts at ``stage``, with the parameters ``known`` (names of NAMES) held at its values.

    Raises:
        IdentificationError: a known name is none of NAMES, or neither mass nor turns is known.
    """
    for name in known:
        if name not in NAMES or name == RATIO:
            allowed = ", ".join(one for one in NAMES if one != RATIO)
            raise IdentificationError(f"known parameter '{name}': is not among the unknowns; allowed: {allowed}")
    if not set(FORCE_SCALE) & set(known):
        raise IdentificationError(
            f"known parameters are {', '.join(known) or 'none'}; allowed: with {' or '.join(FORCE_SCALE)} among them, "
            "since position and current determine all forces only up to a common factor"
        )
    friction = stage.friction
    ratio_of = friction.static / friction.coulomb if friction.coulomb > 0.0 else 1.0
    values: dict[str, Any] = {**to_mapping(stage), RATIO: ratio_of}
    held = {*known, *(_DRY if friction.coulomb == 0.0 else ())}
    start = _logarithms(values[name] if name in held else max(values[name], _SMALLEST.get(name, 0.0)) for name in NAMES)
    low, high = start - _REACH, start + _REACH
    ratio = NAMES.index(RATIO)
    low[ratio] = 0.0
    return Unknowns(start, low, high, [place for place, name in enumerate(NAMES) if name not in held], stage)


def _logarithms(values: Iterable[float]) -> Array:
    """Of ``values``, among which may be held ones of 0."""
    with np.errstate(divide="ignore"):
        return np.log(list(values))


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


def centre(recording: Recording, stribeck: float) -> Centre | None:
    """The centre of the magnets; None where the record has too little sliding, or shows no stiffness.

    A readback with an offset looks the same: the centre is that of the measured current. ``stribeck`` is the described
    Stribeck velocity in m/s.
    """
    found = _sliding(recording, stribeck)
    # A flexure that is stiffer than the magnets has a negative one.
    if found is None or abs(found[0][1]) <= _CERTAIN * math.sqrt(found[1][1, 1]):
        return None
    (_, stiffness, _, _, constant), covariance = found[0].tolist(), found[1]
    value = -constant / stiffness
    # Of y_c = −c/b to first order in both.
    by_slopes = np.array([0.0, -value / stiffness, 0.0, 0.0, -1.0 / stiffness])
    return Centre(value, math.sqrt(float(by_slopes @ covariance @ by_slopes)))


def sliding_start(recording: Recording, unknowns: Unknowns) -> Array | None:
    """The unknowns' vector (9,) as sliding alone identifies it; elements that are not free stay as they start.

    None where the record has too little sliding, or a stiffness or friction comes out negative.
    """
    found = _sliding(recording, unknowns.stage.friction.stribeck_velocity)
    if found is None or found[0][:3].min() <= 0.0:
        return None
    current_gain, position_gain, coulomb, viscous, _ = found[0].tolist()
    values = dict(zip(NAMES, np.exp(unknowns.start).tolist(), strict=True))
    free, given = {NAMES[place] for place in unknowns.free}, unknowns.stage
    if "actuator.air_gap" in free:
        # K̄_y alone, without the flexure.
        position_gain += given.platform.stiffness / values["platform.mass"]
        values["actuator.air_gap"] = given.actuator.bias_current * current_gain / position_gain
    # K̄_i / N², from (3)
    per_turns = MU_0 * given.actuator.pole_area * given.actuator.bias_current / values["actuator.air_gap"] ** 2
    if "platform.mass" in free:
        values["platform.mass"] = per_turns * values["actuator.turns"] ** 2 / current_gain
    if "actuator.turns" in free:
        values["actuator.turns"] = math.sqrt(current_gain * values["platform.mass"] / per_turns)
    if "friction.coulomb" in free:
        values["friction.coulomb"] = coulomb * values["platform.mass"]
    if "friction.viscous" in free:
        values["friction.viscous"] = max(_SMALLEST["friction.viscous"], viscous * values["platform.mass"])
    vector = _logarithms(values[name] for name in NAMES)
    return np.asarray(np.clip(vector, unknowns.low, unknowns.high))


def _sliding(recording: Recording, stribeck: float) -> tuple[Array, Array] | None:
    """K̄_i/M, K̄_y/M, F_C/M, σ2/M and c in SI units (5,), and their covariance (5, 5), infinite where the sliding has no
    more blocks than unknowns; None with too little sliding. ``stribeck`` is the described Stribeck velocity in m/s."""
    period = recording.period_ns * 1e-9
    window = max(_ORDER + 2, 2 * round(0.5 * _WINDOW / period) + 1)

    def filtered(values: Array, derivative: int = 0) -> Array:
        return np.asarray(savgol_filter(values, window, _ORDER, deriv=derivative, delta=period))

    velocity = filtered(recording.y, 1)
    direction = np.sign(velocity)
    slowest = minimum_filter1d(np.abs(velocity), window)
    # At its ends the filter extrapolates.
    slowest[:window] = slowest[-window:] = 0.0
    sliding = slowest > _SLIDING
    least = min(_SAMPLES, _LEAST / period)
    if np.count_nonzero(sliding) < least:
        # A platform of little travel is slow in the whole record.
        sliding = slowest > min(_SLIDING, _SLOW * stribeck)
    if np.count_nonzero(sliding) < least:
        return None
    signals = (filtered(recording.current), filtered(recording.y), -direction, -velocity, np.ones_like(velocity))
    terms, wanted = np.stack(signals, axis=1)[sliding], filtered(recording.y, 2)[sliding]
    slopes, *_ = np.linalg.lstsq(terms, wanted, rcond=None)
    block = max(1, round(BLOCK / period))
    if len(terms) // block <= slopes.size:
        return np.asarray(slopes), np.full((slopes.size, slopes.size), np.inf)
    return np.asarray(slopes), block_covariance(terms, wanted - terms @ slopes, block)


def block_covariance(jacobian: Array, residuals: Array, block: int, prior: float = np.inf) -> Array:
    """(m, m): (JᵀJ)⁻¹ (Σ s sᵀ) (JᵀJ)⁻¹ with s = Jᵀr of each block, so that errors may be alike within a block.

    J is (n, m), r (n,), ``block`` a number of samples. What the residuals do not determine gets ``prior``, the standard
    deviation of a prior around the solution.
    """
    information = jacobian.T @ jacobian
    inverse = np.linalg.inv(information + np.eye(len(information)) / prior**2)
    count = len(residuals) // block
    used = slice(0, count * block)
    scores = (jacobian[used] * residuals[used, None]).reshape(count, block, -1).sum(axis=1)
    spread = inverse @ (scores.T @ scores) @ inverse * count / max(1, count - len(information))
    return np.asarray(spread + inverse @ inverse / prior**2)
