"""One step of friction with all that goes beyond plain LuGre: Maxwell-slip blocks, bands, rest, a step in time.

Constants and state are places in the plant's own arrays, which plain LuGre does not read.
"""

import math

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.friction_changes import age_after, band_factor, rest_factor
from straightcomp_ros.model.lugre import LuGre, bristle_after, friction_force, stribeck_force
from straightcomp_ros.model.maxwell_slip import MOST_BLOCKS, block_after, slips_on

KIND = 12
"""Place of the kind of friction in the plant's constants, after mass, stop, amplifier, magnets and LuGre."""
_ATTRACTION, _BLOCKS, _FRACTION, _WIDTH, _SEED, _GROWTH, _REST_TIME, _LARGEST, _RENEWAL, _FACTOR, _STEP_TIME = range(
    KIND + 1, KIND + 12
)
_STIFFNESS = KIND + 12
_SHARE = _STIFFNESS + MOST_BLOCKS
_BRISTLE = 2
TIME, AGE, SLIPPING, BLOCK = range(7, 11)
"""Places in the plant's state: time s, age of the contact s, bits of the slipping blocks, force of the first in N."""
PLAIN, CHANGING_LUGRE, MAXWELL_SLIP = 0.0, 1.0, 2.0
"""Kinds of friction."""


@compilable
def lugre_now(k: NDArray[np.float64], lugre: LuGre, state: NDArray[np.float64], y: float) -> LuGre:
    """LuGre's constants with the level of this place, age and time."""
    factor = 1.0
    if k[_FRACTION] > 0.0:
        factor = band_factor(k[_FRACTION], k[_WIDTH], int(k[_SEED]), y)
    if state[TIME] >= k[_STEP_TIME]:
        factor *= k[_FACTOR]
    rise = lugre.static - lugre.coulomb
    if k[_GROWTH] > 0.0:
        rise *= rest_factor(k[_GROWTH], k[_REST_TIME], k[_LARGEST], state[AGE])
    return LuGre(
        factor * lugre.coulomb,
        factor * (lugre.coulomb + rise),
        lugre.stribeck_velocity,
        lugre.bristle_stiffness,
        lugre.bristle_damping,
        lugre.viscous,
    )


@compilable
def extended_force(k: NDArray[np.float64], lugre: LuGre, state: NDArray[np.float64], velocity: float) -> float:
    """F in N, with ``lugre`` from :func:`lugre_now`; it acts against the motion."""
    if k[KIND] == CHANGING_LUGRE:
        return friction_force(lugre, state[_BRISTLE], velocity)
    force, stuck, slipping = 0.0, 0.0, int(state[SLIPPING])
    for i in range(int(k[_BLOCKS])):
        force += state[BLOCK + i]
        if not slips_on((slipping >> i) & 1 == 1, state[BLOCK + i], velocity):
            stuck += k[_STIFFNESS + i]
    damping = lugre.bristle_damping * stuck / lugre.bristle_stiffness
    return force + (damping + lugre.viscous) * velocity


@compilable
def step_friction(
    k: NDArray[np.float64], lugre: LuGre, state: NDArray[np.float64], velocity: float, duration: float
) -> None:
    """Advance time, age and bristles or blocks in ``state`` by ``duration`` s at constant velocity.

    Args:
        k: constants of the plant.
        lugre: from :func:`lugre_now`.
        state: of the plant; its places ``_BRISTLE`` and from TIME on are changed.
        velocity: m/s.
        duration: s.
    """
    state[TIME] += duration
    state[AGE] = age_after(state[AGE], velocity, duration, k[_RENEWAL])
    if k[KIND] == CHANGING_LUGRE:
        state[_BRISTLE] = bristle_after(lugre, state[_BRISTLE], velocity, duration)
        return
    level = stribeck_force(lugre, velocity)
    decay = math.exp(-k[_ATTRACTION] / level * duration)
    before, after = int(state[SLIPPING]), 0
    for i in range(int(k[_BLOCKS])):
        state[BLOCK + i], slips = block_after(
            state[BLOCK + i],
            (before >> i) & 1 == 1,
            k[_STIFFNESS + i],
            k[_SHARE + i] * level,
            decay,
            velocity,
            duration,
        )
        if slips:
            after |= 1 << i
    state[SLIPPING] = float(after)
