"""What changes the level of friction: the place on the guide, the time at rest, and a step in time.

    s(v, y, t) = c(y) e(t) [F_C + (F_S − F_C) G(θ) exp(−(v/v_s)²)]
    c(y) = 1 + a u(y/w),                    u: smooth noise between −1 and 1 with one value per band
    G(θ) = min(G_max, 1 + b ln(1 + θ/t0)),  θ̇ = 1 − |v| θ/D
    e(t) = factor from the time of the step on, 1 before

At rest the age θ of the contact is the time since it stopped. The logarithm is from Dieterich, Journal of Geophysical
Research 77(20), 1972; the ageing law, by which the contact is renewed within the sliding distance D, from Dieterich,
Journal of Geophysical Research 84(B5), 1979, and Ruina, Journal of Geophysical Research 88(B12), 1983.
"""

import math
from dataclasses import dataclass

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import parameter

_MASK = 0xFFFFFFFF


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
    place = y / width
    band = math.floor(place)
    inside = place - band
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
def rest_factor(growth: float, time: float, largest: float, age: float) -> float:
    """G(θ)."""
    return min(largest, 1.0 + growth * math.log1p(age / time))
