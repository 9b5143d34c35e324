"""LuGre friction of the sliding platform (Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40(3), 1995).

    ż = v − σ0 |v| z / g(v),   F = σ0 z + σ1 ż + σ2 v,   g(v) = F_C + (F_S − F_C) exp(−(v/v_s)²)

z is the mean deflection of the bristles in m; F opposes the motion.
"""

import math
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.friction_changes import BandParameters, RestParameters, StepParameters
from straightcomp_ros.model.maxwell_slip import MOST_BLOCKS, MaxwellSlipParameters
from straightcomp_ros.parameters.declaration import RefusedParameter, group, parameter

_MODELS = ("lugre", "maxwell_slip")
NO_EXTENSION = (0.0,) * (12 + 2 * MOST_BLOCKS)
"""What :meth:`ContactParameters.extension` gives for plain LuGre friction."""


class LuGre(NamedTuple):
    """F_C, F_S in N, v_s in m/s, σ0 in N/m, σ1 and σ2 in N·s/m."""

    coulomb: float
    static: float
    stribeck_velocity: float
    bristle_stiffness: float
    bristle_damping: float
    viscous: float


@dataclass(frozen=True)
class LuGreParameters:
    """The constants of the LuGre model."""

    coulomb: float = parameter(0.43, "Coulomb friction F_C", "(0, 1000] N")
    static: float = parameter(0.645, "Static friction F_S, at least F_C", "(0, 1000] N")
    stribeck_velocity: float = parameter(20e-6, "Stribeck velocity v_s", "(0, 1] m/s")
    bristle_stiffness: float = parameter(1e6, "Bristle stiffness σ0", "(0, 1e+10] N/m")
    bristle_damping: float = parameter(1000.0, "Bristle damping σ1", "[0, 1e6] N·s/m")
    viscous: float = parameter(10.0, "Viscous friction σ2", "[0, 100000] N·s/m")

    def __post_init__(self) -> None:
        if self.static < self.coulomb:
            raise RefusedParameter(
                "static",
                f"{self.static!r} N is below Coulomb friction; allowed: >= {self.coulomb!r} N ('{{group}}coulomb')",
            )

    def constants(self) -> LuGre:
        """The constants of the friction functions."""
        return LuGre(*astuple(self))


@dataclass(frozen=True)
class ContactParameters:
    """What a simulated contact does beyond the LuGre model."""

    model: str = parameter("lugre", "Model of the friction: bristles, or elasto-slip blocks", choices=_MODELS)
    maxwell_slip: MaxwellSlipParameters = group(MaxwellSlipParameters, "Simulated friction (Maxwell-slip)")
    bands: BandParameters = group(BandParameters, "Simulated friction along y")
    rest: RestParameters = group(RestParameters, "Simulated friction after rest")
    step: StepParameters = group(StepParameters, "Simulated step of friction")

    def extension(self, bristle_stiffness: float) -> tuple[float, ...]:
        """The constants beyond LuGre's, in the order of :mod:`straightcomp_ros.model.extended_friction`: (28,).

        ``bristle_stiffness`` is σ0 in N/m, which the Maxwell-slip blocks share out.
        """
        changes = self.bands.fraction > 0.0 or self.rest.growth > 0.0 or self.step.factor != 1.0
        if self.model == "lugre" and not changes:
            return NO_EXTENSION
        blocks = np.zeros((2, MOST_BLOCKS))
        slip = self.maxwell_slip
        blocks[:, : slip.blocks] = slip.stiffnesses_and_shares(bristle_stiffness)
        kind = 1.0 + _MODELS.index(self.model)
        changing = (*astuple(self.bands), *astuple(self.rest), *astuple(self.step))
        return (kind, slip.attraction, float(slip.blocks), *changing, *blocks.ravel().tolist())


@compilable
def stribeck_force(lugre: LuGre, velocity: float) -> float:
    """g(v) in N: the steady-state friction without its viscous part."""
    ratio = velocity / lugre.stribeck_velocity
    return lugre.coulomb + (lugre.static - lugre.coulomb) * math.exp(-ratio * ratio)


@compilable
def friction_force(lugre: LuGre, bristle: float, velocity: float) -> float:
    """F in N for bristle deflection z in m and velocity in m/s; it acts against the motion."""
    bristle_rate = velocity - lugre.bristle_stiffness * abs(velocity) * bristle / stribeck_force(lugre, velocity)
    return lugre.bristle_stiffness * bristle + lugre.bristle_damping * bristle_rate + lugre.viscous * velocity


@compilable
def bristle_after(lugre: LuGre, bristle: float, velocity: float, duration: float) -> float:
    """z after ``duration`` s at constant velocity, exact: an explicit step must be below 6 µs at 0.1 m/s."""
    if velocity == 0.0:
        return bristle
    level = stribeck_force(lugre, velocity)
    settled = math.copysign(level / lugre.bristle_stiffness, velocity)
    decay = math.exp(-lugre.bristle_stiffness * abs(velocity) / level * duration)
    return settled + (bristle - settled) * decay
