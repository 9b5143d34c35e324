"""The parameters to identify, as a vector of logarithms with its start and bounds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.model.actuator import MU_0, Actuator
from straightcomp_ros.model.friction import LuGre
from straightcomp_ros.model.plant import Plant, as_array
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.stage.description import StageParameters

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
"""At least one of these must be known: position and current tell all forces only up to a common factor."""
_STOP = 0.9
"""Stop as a fraction of the air gap; the platform stays far from it."""
_SMALLEST = {"friction.bristle_damping": 1.0, "friction.viscous": 0.1}
"""Start of parameters that may be zero, which has no logarithm."""
_REACH = math.log(100.0)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Start and bounds of the search.

    Attributes:
        start, low, high: (9,) natural logarithms of the values of NAMES in SI units.
        free: indices of the unknown elements.
        pole_area, bias_current: of the magnets, m² and A; taken as given.
    """

    start: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    free: tuple[int, ...]
    pole_area: float
    bias_current: float

    def constants(self, vector: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
        """The plant's constants (40,) for `plant.advance`, from (9,) logarithms and the amplifier's rate in rad/s."""
        mass, turns, gap, coulomb, ratio, stribeck, stiffness, damping, viscous = np.exp(vector).tolist()
        actuator = Actuator(MU_0 * turns * turns * self.pole_area / 4.0, gap, self.bias_current)
        lugre = LuGre(coulomb, coulomb * ratio, stribeck, stiffness, damping, viscous)
        return as_array(Plant(mass, _STOP * gap, rate, actuator, lugre))


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
            "since position and current tell all forces only up to a common factor"
        )
    values: dict[str, Any] = {**to_mapping(stage), RATIO: stage.friction.static / stage.friction.coulomb}
    start = np.log([max(values[name], _SMALLEST.get(name, 0.0)) for name in NAMES])
    low, high = start - _REACH, start + _REACH
    ratio = NAMES.index(RATIO)
    low[ratio] = 0.0
    free = tuple(place for place, name in enumerate(NAMES) if name not in known)
    return Unknowns(start, low, high, free, stage.actuator.pole_area, stage.actuator.bias_current)
