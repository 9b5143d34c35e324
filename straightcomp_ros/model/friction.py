"""Friction of the sliding platform: the LuGre model, and what a simulated contact does beyond it.

LuGre (Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40(3), 1995), with the mean deflection z of the bristles in
m; F opposes the motion:

    ż = v − σ0 |v| z / g(v),   F = σ0 z + σ1 ż + σ2 v,   g(v) = F_C + (F_S − F_C) exp(−(v/v_s)²)

The level of friction may change with the place on the guide, with the time at rest, and by a step in time:

    s(v, y, t) = c(y) e(t) [F_C + (F_S − F_C) G(θ) exp(−(v/v_s)²)]
    c(y) = 1 + a u(y/w),                    u: smooth noise between −1 and 1 with one value per band
    G(θ) = min(G_max, 1 + b ln(1 + θ/t0)),  θ̇ = 1 − |v| θ/D
    e(t) = factor from the time of the step on, 1 before

At rest the age θ of the contact is the time since it stopped. The logarithm is from Dieterich, Journal of Geophysical
Research 77(20), 1972; the ageing law, by which the contact is renewed within the sliding distance D, from Dieterich,
Journal of Geophysical Research 84(B5), 1979, and Ruina, Journal of Geophysical Research 88(B12), 1983.

In place of the bristles there may be elasto-slip blocks in parallel, the generalised Maxwell-slip model (Al-Bender,
Lampaert, Swevers, IEEE TAC 50(11), 2005). Block i carries the force F_i and holds the share α_i of the level s(v):

    stuck:    Ḟ_i = k_i v, until |F_i| = α_i s(v)
    slipping: Ḟ_i = sgn(v) C (α_i − F_i/s(v)), until v changes its sign
    F = Σ F_i + σ1 v Σ_stuck k_i/σ0 + σ2 v,   Σ α_i = 1,   Σ k_i = σ0

While a block slips, |F_i| rises at most at k_i |v| here. Without this bound, a block whose level rises faster than the
motion bends it would store energy that nothing supplied.
"""

import math
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import RefusedParameter, group, parameter

Array = NDArray[np.float64]

BLOCKS = "maxwell_slip"
_MODELS = ("lugre", BLOCKS)
DESCRIBED = "described"
"""Names of the models; the last, of a simulated contact, is that of its description."""
MOST_BLOCKS = 8
"""Room for blocks in the plant's constants and state."""
NO_EXTENSION = (0.0,) * (12 + 2 * MOST_BLOCKS)
"""What :meth:`ContactParameters.extension` gives for plain LuGre friction."""
_MASK = 0xFFFFFFFF

KIND = 15
"""Index of the kind of friction in the plant's constants, after mass, stop, amplifier, magnets, LuGre, flexure and
substep."""
_ATTRACTION, _BLOCKS, _FRACTION, _WIDTH, _SEED, _GROWTH, _REST_TIME, _LARGEST, _RENEWAL, _FACTOR, _STEP_TIME = range(
    KIND + 1, KIND + 12
)
_STIFFNESS = KIND + 12
_SHARE = _STIFFNESS + MOST_BLOCKS
_BRISTLE = 2
TIME, AGE, SLIPPING, BLOCK = range(7, 11)
"""Indices in the plant's state: time s, age of the contact s, bits of the slipping blocks, force of the first in N."""
PLAIN, CHANGING_LUGRE, MAXWELL_SLIP = 0.0, 1.0, 2.0
"""Kinds of friction."""


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
    """The constants of the LuGre model, and what gives way before the contact slides."""

    coulomb: float = parameter(0.43, "Coulomb friction F_C; 0, with F_S 0, without dry friction", "[0, 1000] N")
    static: float = parameter(0.645, "Static friction F_S, at least F_C", "[0, 1000] N")
    stribeck_velocity: float = parameter(20e-6, "Stribeck velocity v_s", "(0, 1] m/s")
    bristle_stiffness: float = parameter(1e6, "Bristle stiffness σ0", "(0, 1e+10] N/m")
    bristle_damping: float = parameter(1000.0, "Bristle damping σ1", "[0, 1e6] N·s/m")
    viscous: float = parameter(10.0, "Viscous friction σ2", "[0, 100000] N·s/m")
    model: str = parameter(
        "lugre",
        "What gives way before the platform slides: bristles, or elasto-slip blocks that share σ0 and F_S out, with "
        "presliding hysteresis; the law's own model has bristles",
        choices=_MODELS,
    )

    def __post_init__(self) -> None:
        if self.static < self.coulomb:
            raise RefusedParameter(
                "static",
                f"{self.static!r} N is below Coulomb friction; allowed: >= {self.coulomb!r} N ('{{group}}coulomb')",
            )
        if self.coulomb == 0.0 < self.static:
            # g(v) in the denominator would vanish as the velocity grows.
            raise RefusedParameter(
                "static", f"{self.static!r} N without Coulomb friction; allowed: 0 N, or '{{group}}coulomb' > 0"
            )

    def constants(self) -> LuGre:
        """The constants of the friction functions."""
        return LuGre(*(getattr(self, name) for name in LuGre._fields))


@dataclass(frozen=True)
class MaxwellSlipParameters:
    """The blocks; their stiffnesses add up to σ0, and their slip limits to the Stribeck level."""

    blocks: int = parameter(4, "Number of elasto-slip blocks", "[1, 8]")
    attraction: float = parameter(
        100.0, "Attraction parameter C: how fast a slipping block follows the Stribeck level", "(0, 1e+12] N/s"
    )
    distance_spread: float = parameter(
        10.0, "Displacement at which the last block slips over that of the first", "[1, 1000]"
    )
    limit_spread: float = parameter(1.0, "Slip limit of the last block over that of the first", "[0.001, 1000]")


@dataclass(frozen=True)
class BandParameters:
    """Dry friction that varies along y."""

    fraction: float = parameter(0.0, "Largest deviation of dry friction along y, as a fraction", "[0, 0.9]")
    width: float = parameter(2e-6, "Width of a band along y", "[1e-9, 1] m")
    seed: int = parameter(0, "Seed of the pattern along y", "[0, 1000000]")


@dataclass(frozen=True)
class RestParameters:
    """Static friction that grows with the time at rest."""

    growth: float = parameter(0.0, "Growth b of F_S − F_C per e-fold of the time at rest", "[0, 100]")
    time: float = parameter(1.0, "Time at rest t0 from which static friction grows", "(0, 1e+06] s")
    largest: float = parameter(2.0, "Largest factor of F_S − F_C that rest gives", "[1, 100]")
    renewal: float = parameter(5e-6, "Sliding distance D that makes the contact new again", "(0, 1] m")


@dataclass(frozen=True)
class StepParameters:
    """A step of dry friction."""

    factor: float = parameter(1.0, "Factor of dry friction from the time of the step on", "[0.001, 1000]")
    time: float = parameter(0.0, "Simulated time of the step since the plant's start", "[0, 1e+09] s")


@dataclass(frozen=True)
class ContactParameters:
    """What a simulated contact does beyond the LuGre model."""

    model: str = parameter(
        DESCRIBED, "Model of the friction: as described, bristles, or elasto-slip blocks", choices=(DESCRIBED, *_MODELS)
    )
    maxwell_slip: MaxwellSlipParameters = group(MaxwellSlipParameters, "Simulated friction (Maxwell-slip)")
    bands: BandParameters = group(BandParameters, "Simulated friction along y")
    rest: RestParameters = group(RestParameters, "Simulated friction after rest")
    step: StepParameters = group(StepParameters, "Simulated step of friction")

    def extension(self, bristle_stiffness: float, extended: bool = False) -> tuple[float, ...]:
        """The constants beyond LuGre's, (28,), which follow it in the plant's constants from :data:`KIND` on.

        ``bristle_stiffness`` is σ0 in N/m, which the Maxwell-slip blocks share out. A plant that is ``extended`` by
        something else has them for plain LuGre too.
        """
        changes = self.bands.fraction > 0.0 or self.rest.growth > 0.0 or self.step.factor != 1.0
        slips = self.model == BLOCKS
        if not slips and not changes and not extended:
            return NO_EXTENSION
        # Stiffnesses k_i and shares α_i, geometric from the first block to the last.
        blocks, slip = np.zeros((2, MOST_BLOCKS)), self.maxwell_slip
        along = np.linspace(0.0, 1.0, slip.blocks)
        shares = slip.limit_spread**along
        springs = shares / slip.distance_spread**along
        blocks[:, : slip.blocks] = bristle_stiffness * springs / springs.sum(), shares / shares.sum()
        kind = MAXWELL_SLIP if slips else CHANGING_LUGRE
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
    if lugre.static <= 0.0:
        return lugre.viscous * velocity
    bristle_rate = velocity - lugre.bristle_stiffness * abs(velocity) * bristle / stribeck_force(lugre, velocity)
    return lugre.bristle_stiffness * bristle + lugre.bristle_damping * bristle_rate + lugre.viscous * velocity


@compilable
def bristle_after(lugre: LuGre, bristle: float, velocity: float, duration: float) -> float:
    """z after ``duration`` s at constant velocity, exact: an explicit step must be below 6 µs at 0.1 m/s."""
    if velocity == 0.0 or lugre.static <= 0.0:
        return bristle
    level = stribeck_force(lugre, velocity)
    settled = math.copysign(level / lugre.bristle_stiffness, velocity)
    decay = math.exp(-lugre.bristle_stiffness * abs(velocity) / level * duration)
    return settled + (bristle - settled) * decay


@compilable
def band_value(seed: int, band: int) -> float:
    """A number from −1 to 1 that depends on both only: an integer hash, exact in 64 bits and hence on any machine."""
    mixed = (band + seed * 2654435) & _MASK
    for _ in range(3):
        mixed = (((mixed >> 16) ^ mixed) * 0x45D9F3B) & _MASK
    return ((mixed >> 16) ^ mixed) * (2.0 / _MASK) - 1.0


@compilable
def band_factor(fraction: float, width: float, seed: int, y: float) -> float:
    """c(y): a band's value holds at its start; between two starts a cubic with no slope at either joins them."""
    along = y / width
    band = math.floor(along)
    inside = along - band
    low, high = band_value(seed, int(band)), band_value(seed, int(band) + 1)
    return 1.0 + fraction * (low + (high - low) * inside * inside * (3.0 - 2.0 * inside))


@compilable
def age_after(age: float, velocity: float, duration: float, renewal: float) -> float:
    """θ in s after ``duration`` s at constant velocity, exact."""
    turns = abs(velocity) * duration / renewal
    if turns < 1e-9:
        return age + duration
    return age * math.exp(-turns) - duration * math.expm1(-turns) / turns


@compilable
def slips_on(slipping: bool, force: float, velocity: float) -> bool:
    """Whether a block that was slipping still does: it sticks when the velocity has changed its sign."""
    return slipping and force * velocity > 0.0


@compilable
def block_after(
    force: float, slipping: bool, stiffness: float, limit: float, decay: float, velocity: float, duration: float
) -> tuple[float, bool]:
    """Force of a block in N, and whether it slips, after ``duration`` s at constant velocity.

    ``limit`` is α_i s(v) in N; ``decay`` is exp(−C/s(v) · duration), 0 for an infinite attraction.
    """
    if velocity == 0.0:
        return force, False
    resisting = math.copysign(1.0, velocity) * force
    bent = resisting + stiffness * abs(velocity) * duration
    if not slips_on(slipping, force, velocity):
        if bent <= limit:
            return math.copysign(1.0, velocity) * bent, False
        # It reaches its limit within the step and stays there, or the limit has fallen below its force.
        resisting = max(resisting, limit)
    after = min(limit + (resisting - limit) * decay, bent)
    return math.copysign(1.0, velocity) * after, True


@compilable
def changes(k: Array) -> bool:
    """Whether LuGre's constants change with place, age or time; ``k`` are the plant's."""
    return bool(k[_FRACTION] > 0.0 or k[_GROWTH] > 0.0 or k[_FACTOR] != 1.0)


@compilable
def lugre_now(k: Array, lugre: LuGre, state: Array, y: float) -> LuGre:
    """LuGre's constants with the level of this place, age and time; ``k`` and ``state`` are the plant's."""
    factor = 1.0
    if k[_FRACTION] > 0.0:
        factor = band_factor(k[_FRACTION], k[_WIDTH], int(k[_SEED]), y)
    if state[TIME] >= k[_STEP_TIME]:
        factor *= k[_FACTOR]
    rise = lugre.static - lugre.coulomb
    if k[_GROWTH] > 0.0:
        rise *= min(k[_LARGEST], 1.0 + k[_GROWTH] * math.log1p(state[AGE] / k[_REST_TIME]))
    _, _, stribeck_velocity, stiffness, damping, viscous = lugre
    return LuGre(
        factor * lugre.coulomb, factor * (lugre.coulomb + rise), stribeck_velocity, stiffness, damping, viscous
    )


@compilable
def extended_force(k: Array, lugre: LuGre, state: Array, velocity: float) -> float:
    """F in N, with ``lugre`` from :func:`lugre_now`; it acts against the motion."""
    if k[KIND] == CHANGING_LUGRE:
        return friction_force(lugre, state[_BRISTLE], velocity)
    if lugre.static <= 0.0:
        return lugre.viscous * velocity
    force, stuck, slipping = 0.0, 0.0, int(state[SLIPPING])
    for i in range(int(k[_BLOCKS])):
        force += state[BLOCK + i]
        if not slips_on((slipping >> i) & 1 == 1, state[BLOCK + i], velocity):
            stuck += k[_STIFFNESS + i]
    damping = lugre.bristle_damping * stuck / lugre.bristle_stiffness
    return force + (damping + lugre.viscous) * velocity


@compilable
def step_friction(k: Array, lugre: LuGre, state: Array, velocity: float, duration: float) -> None:
    """Advance time, age and bristles or blocks in ``state`` by ``duration`` s at constant velocity, with ``lugre``
    from :func:`lugre_now`."""
    state[TIME] += duration
    if k[_GROWTH] > 0.0:
        state[AGE] = age_after(state[AGE], velocity, duration, k[_RENEWAL])
    if k[KIND] == CHANGING_LUGRE:
        state[_BRISTLE] = bristle_after(lugre, state[_BRISTLE], velocity, duration)
        return
    if lugre.static <= 0.0:
        return
    level = stribeck_force(lugre, velocity)
    decay = math.exp(-k[_ATTRACTION] / level * duration)
    before, after = int(state[SLIPPING]), 0
    for i in range(int(k[_BLOCKS])):
        slipping, limit = (before >> i) & 1 == 1, k[_SHARE + i] * level
        state[BLOCK + i], slips = block_after(
            state[BLOCK + i], slipping, k[_STIFFNESS + i], limit, decay, velocity, duration
        )
        if slips:
            after |= 1 << i
    state[SLIPPING] = float(after)
