"""The answer in words and numbers: values with 95 % intervals, what is poorly determined, and what would help."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from straightcomp_ros.identification.current_path import CurrentPath, current_path
from straightcomp_ros.identification.fit import Fit, fit
from straightcomp_ros.identification.stretch import Recording, read_recording
from straightcomp_ros.identification.unknowns import NAMES, RATIO, Unknowns, unknowns
from straightcomp_ros.model.plant import PlantParameters

POOR = 1.3
"""Interval bounds further than this factor from the value: poorly determined."""
CORRELATED = 0.95
_CONFIDENCE = 0.95
_LEAST = 0.002
"""Relative standard deviation below which no claim is made: current path and model are not better than that."""
_WIDEST = 1e3
UNITS = {
    "mass": "kg",
    "actuator.turns": "",
    "actuator.air_gap": "m",
    "actuator.current_stiffness": "N/A",
    "actuator.position_stiffness": "N/m",
    "friction.coulomb": "N",
    "friction.static": "N",
    "friction.stribeck_velocity": "m/s",
    "friction.bristle_stiffness": "N/m",
    "friction.bristle_damping": "N·s/m",
    "friction.viscous": "N·s/m",
}
DERIVED = ("actuator.current_stiffness", "actuator.position_stiffness")
"""K̄_i and K̄_y: shown, but not parameters of their own."""
HELP = {
    "mass": "quick motion of the platform: force must go into acceleration, not only into friction",
    "actuator.turns": "quick motion of the platform: force must go into acceleration, not only into friction",
    "actuator.air_gap": "positions far to both sides of the centre",
    "friction.coulomb": "steady sliding both ways, far faster than the Stribeck velocity",
    "friction.static": "slow sliding and many starts from rest",
    "friction.stribeck_velocity": "sliding at many speeds, slow ones above all",
    "friction.bristle_stiffness": "many reversals of the motion",
    "friction.bristle_damping": "quick small movements around rest",
    "friction.viscous": "fast sliding",
}


@dataclass(frozen=True)
class Estimated:
    """One parameter: SI value with its 95 % interval; ``known`` ones were given, and have no width.

    ``with_others`` names parameters that this record hardly tells apart from it.
    """

    name: str
    value: float
    low: float
    high: float
    known: bool
    with_others: tuple[str, ...] = ()

    @property
    def poor(self) -> bool:
        """Whether the record determines it poorly."""
        return not self.known and max(self.high / self.value, self.value / self.low) > POOR


@dataclass(frozen=True)
class Estimate:
    """All parameters, in the order of UNITS, and how well the model explains the record.

    Attributes:
        parameters: by dotted name below ``simulated.plant.``.
        recording: what was used of the bag.
        path: of the coil current between the samples.
        fit: the search's own figures.
    """

    parameters: dict[str, Estimated]
    recording: Recording
    path: CurrentPath
    fit: Fit

    @property
    def advice(self) -> dict[str, str]:
        """For each poorly determined parameter, what excitation would help."""
        return {name: HELP[name] for name, found in self.parameters.items() if found.poor and name in HELP}


def estimate_from_bag(
    bag: Path,
    start: PlantParameters,
    known: Sequence[str],
    progress: Callable[[float], None] = lambda fraction: None,
) -> Estimate:
    """Estimate the plant's parameters from encoder and command of a bag.

    Args:
        bag: rosbag2 folder or MCAP file.
        start: where the search starts; pole area, bias current and encoder resolution are taken from it as they are.
        known: parameters that are held at the values of ``start``.
        progress: called with the fraction that is done.

    Raises:
        BagError: the bag cannot be read.
        IdentificationError: the bag is not fit for it, or ``known`` is refused.
    """
    searched = unknowns(start, known)
    recording = read_recording(bag)
    path = current_path(recording, start.drive)
    found = fit(recording, path, searched, start.encoder.resolution, progress)
    parameters = _parameters(found, searched, blocks=max(2, int(recording.duration / 0.25)))
    return Estimate(parameters, recording, path, found)


def _parameters(found: Fit, searched: Unknowns, blocks: int) -> dict[str, Estimated]:
    places = {name: place for place, name in enumerate(NAMES)}
    free = list(searched.free)
    total = np.zeros((len(NAMES), len(NAMES)))
    # The pull that may be left is as large as its last changes, each of which moves all parameters together.
    total[np.ix_(free, free)] = found.covariance + found.pulls.T @ found.pulls
    total[free, free] += _LEAST**2
    quantile = float(student.ppf(0.5 + 0.5 * _CONFIDENCE, max(1, blocks - len(free))))
    logarithm_of: dict[str, dict[str, float]] = {name: {name: 1.0} for name in NAMES if name != RATIO}
    logarithm_of["friction.static"] = {"friction.coulomb": 1.0, RATIO: 1.0}
    # (3): K̄_i = μ0 N² A I0 / y0², K̄_y = K̄_i I0 / y0
    logarithm_of[DERIVED[0]] = {"actuator.turns": 2.0, "actuator.air_gap": -2.0}
    logarithm_of[DERIVED[1]] = {"actuator.turns": 2.0, "actuator.air_gap": -3.0}
    stiffness = _stiffness(found.vector, searched)
    estimated = {}
    for name in UNITS:
        weights = np.zeros(len(NAMES))
        for part, weight in logarithm_of[name].items():
            weights[places[part]] = weight
        value = stiffness.get(name) or float(np.exp(weights @ found.vector))
        deviation = math.sqrt(max(0.0, float(weights @ total @ weights)))
        factor = math.exp(min(quantile * deviation, math.log(_WIDEST)))
        others = () if name in DERIVED else _alike(name, found.covariance, free)
        estimated[name] = Estimated(name, value, value / factor, value * factor, deviation == 0.0, others)
    static, coulomb = estimated["friction.static"], estimated["friction.coulomb"]
    low = max(static.low, min(coulomb.low, static.value))
    estimated["friction.static"] = Estimated(
        static.name, static.value, low, static.high, static.known, static.with_others
    )
    return estimated


def _stiffness(vector: NDArray[np.float64], searched: Unknowns) -> dict[str, float]:
    actuator = searched.constants(vector, 1.0)[3:6]
    coefficient, gap, bias = (float(number) for number in actuator)
    current_stiffness = 4.0 * coefficient * bias / gap**2
    return {DERIVED[0]: current_stiffness, DERIVED[1]: current_stiffness * bias / gap}


def _alike(name: str, covariance: NDArray[np.float64], free: list[int]) -> tuple[str, ...]:
    """Names of the free parameters that are correlated with ``name`` by more than CORRELATED."""
    shown = [NAMES[place] if NAMES[place] != RATIO else "friction.static" for place in free]
    if name not in shown:
        return ()
    deviations = np.sqrt(np.diag(covariance))
    correlation = covariance[shown.index(name)] / (deviations * deviations[shown.index(name)])
    return tuple(
        other for other, value in zip(shown, correlation, strict=True) if other != name and abs(value) > CORRELATED
    )
