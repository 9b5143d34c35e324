"""Resonances of the platform: modes between the coils, which the forces act on, and the encoder of y.

Beside the motion of the whole mass M the platform has modes q with the angular frequency ω and the damping ratio ζ:

    q̈ + 2 ζ ω q̇ + ω² q = φ_c f/M,   y_coil = y + Σ φ_c q,   y_encoder = y + Σ φ_e q

so that from force to encoder 1/(M s²) becomes (1/M) [1/s² + Σ φ_c φ_e/(s² + 2ζωs + ω²)] (Preumont, Vibration Control of
Active Structures, 2011, chapter 2). Two masses m_1, which the coils drive, and m_2 on a spring have φ_c = √(m_2/m_1),
and φ_e = φ_c for an encoder on m_1 (collocated) or −1/φ_c for one on m_2: φ_c φ_e = m_2/m_1 or −1.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import group, parameter

Array = NDArray[np.float64]

_MODE = 43
_FIELDS = 7
LEAST_DAMPING, MOST_DAMPING = 1e-4, 0.99
"""Damping ratios that a description may have: of a mode that swings, and whose swing ends."""
MODE_STATE = 18
"""Index of the first mode's q in the plant's state; its rate follows, then the other mode's."""


@dataclass(frozen=True)
class TrueModeParameters:
    """One resonance."""

    frequency: float = parameter(0.0, "Frequency; 0: there is no such mode", "[0, 100000] Hz")
    damping: float = parameter(0.01, "Damping ratio", f"[{LEAST_DAMPING}, {MOST_DAMPING}]")
    coil: float = parameter(
        1.0, "Participation φ_c at the coils, relative to the motion of the whole mass", "[-100, 100]"
    )
    encoder: float = parameter(
        1.0,
        "Participation φ_e at the encoder of y; its sign differs from that at the coils if they are apart",
        "[-100, 100]",
    )

    @property
    def residue(self) -> float:
        """φ_c φ_e, by which the mode is seen from coil to encoder, relative to the rigid motion."""
        return self.coil * self.encoder

    def constants(self) -> tuple[float, ...]:
        """What the plant's constants have of it."""
        if not self.frequency:
            return (0.0,) * _FIELDS
        omega = 2.0 * math.pi * self.frequency
        turning = omega * math.sqrt(1.0 - self.damping**2)
        return (
            omega,
            self.damping * omega,
            turning,
            self.damping * omega / turning,
            1.0 / turning,
            self.coil,
            self.encoder,
        )


@dataclass(frozen=True)
class ModeParameters(TrueModeParameters):
    """One resonance as it is described, and how well it is known."""

    frequency_error: float = parameter(0.03, "Frequency: uniform within ± this fraction of it", "[0, 0.5]")
    damping_factor: float = parameter(1.5, "Damping: between one over this factor and this factor", "[1, 100]")
    participation_error: float = parameter(0.2, "φ_c φ_e: uniform within ± this fraction of it", "[0, 0.9]")


@dataclass(frozen=True)
class ModesParameters:
    """The resonances of a platform, the strongest ones."""

    first: ModeParameters = group(ModeParameters, "First resonance of the platform")
    second: ModeParameters = group(ModeParameters, "Second resonance of the platform")

    @property
    def present(self) -> tuple[ModeParameters, ...]:
        """Those that there are."""
        return tuple(mode for mode in (self.first, self.second) if mode.frequency)

    def constants(self) -> tuple[float, ...]:
        """What the plant's constants have from index 43 on, (14,)."""
        return (*self.first.constants(), *self.second.constants())


@dataclass(frozen=True)
class TrueModesParameters:
    """The resonances of a simulated platform, in place of those described."""

    first: TrueModeParameters = group(
        TrueModeParameters, "First resonance of the simulated machine, in place of those described"
    )
    second: TrueModeParameters = group(
        TrueModeParameters, "Second resonance of the simulated machine, in place of those described"
    )

    @property
    def as_described(self) -> ModesParameters:
        """The same as they would be described."""
        return ModesParameters(*(ModeParameters(**vars(mode)) for mode in (self.first, self.second)))


def off(mode: ModeParameters, frequency: float, damping: float, participation: float) -> ModeParameters:
    """The mode at these shares, from −1 to 1, of its uncertainty."""
    return replace(
        mode,
        frequency=mode.frequency * (1.0 + frequency * mode.frequency_error),
        damping=min(MOST_DAMPING, mode.damping * mode.damping_factor**damping),
        coil=mode.coil * (1.0 + participation * mode.participation_error),
    )


class Turn(NamedTuple):
    """q and q̇ after a time from those before: the free motion, exact."""

    qq: float
    qr: float
    rq: float
    rr: float


@compilable
def turn(k: Array, mode: int, duration: float) -> Turn:
    """The free motion of a mode over ``duration`` s; ``k`` are the plant's constants."""
    at = _MODE + mode * _FIELDS
    left = math.exp(-k[at + 1] * duration)
    cosine, sine = left * math.cos(k[at + 2] * duration), left * math.sin(k[at + 2] * duration)
    return Turn(
        cosine + k[at + 3] * sine, k[at + 4] * sine, -(k[at] ** 2) * k[at + 4] * sine, cosine - k[at + 3] * sine
    )


@compilable
def swing(state: Array, mode: int, t: Turn) -> None:
    """Let a mode move freely."""
    at = MODE_STATE + 2 * mode
    q, rate = state[at], state[at + 1]
    state[at], state[at + 1] = t.qq * q + t.qr * rate, t.rq * q + t.rr * rate


@compilable
def push(k: Array, state: Array, gained: float) -> None:
    """Give the whole mass the velocity ``gained``, m/s, at the coils, and the modes their share of it."""
    state[1] += gained
    state[MODE_STATE + 1] += k[_MODE + 5] * gained
    state[MODE_STATE + 3] += k[_MODE + _FIELDS + 5] * gained


@compilable
def yielding(k: Array) -> float:
    """The velocity that the coils gain by a push, relative to the whole mass's."""
    return float(1.0 + k[_MODE + 5] ** 2 + k[_MODE + _FIELDS + 5] ** 2)


@compilable
def at_coil(k: Array, state: Array, rate: int) -> float:
    """Position (``rate`` 0, m) or velocity (1, m/s) of the coils."""
    moved = k[_MODE + 5] * state[MODE_STATE + rate] + k[_MODE + _FIELDS + 5] * state[MODE_STATE + 2 + rate]
    return float(state[rate] + moved)


@compilable
def at_encoder(k: Array, state: Array, rate: int) -> float:
    """The same where the encoder of y looks."""
    moved = k[_MODE + 6] * state[MODE_STATE + rate] + k[_MODE + _FIELDS + 6] * state[MODE_STATE + 2 + rate]
    return float(state[rate] + moved)
