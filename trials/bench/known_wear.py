"""Wear whose size and beginning are known, and what a sound stage does from day to day."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.fleet.maintenance.level_change import MONTH, WEEK


@dataclass(frozen=True)
class Climate:
    """How a sound stage differs from day to day: assumed, not measured. First-order autoregressive, each day 0.8 of the
    day before; standard deviations, relative or in the unit named. There are no seasons."""

    friction: float = 0.02
    amplifier: float = 0.003
    scale: float = 0.003
    bow_um: float = 0.02
    latency_p50_us: float = 3.0
    latency_p99_us: float = 10.0


ASSUMED = Climate()


class Machine(NamedTuple):
    """A day's machine beside the description: factors, µm at the middle of the guide's moved place, µs."""

    friction: float = 1.0
    amplifier: float = 1.0
    scale: float = 1.0
    settled_um: float = 0.0
    kink_um: float = 0.0
    slower: float = 0.0


@dataclass(frozen=True)
class Wear:
    """A known wear: its name, in words, the causes of advice that are right, and the machine so many days after it
    began."""

    name: str
    words: str
    causes: tuple[str, ...]
    machine: Callable[[float], Machine]


SOUND = Wear("sound", "sound", (), lambda days: Machine())
WEARS = (
    Wear("friction", "friction +1 % a week", ("friction_up",), lambda days: Machine(friction=1.0 + 0.01 * days / WEEK)),
    Wear("guide", "guide +0.05 µm a month", ("guide",), lambda days: Machine(settled_um=0.05 * days / MONTH)),
    Wear("scale", "scale of y +0.5 % a month", ("stiffness",), lambda days: Machine(scale=1.0 + 0.005 * days / MONTH)),
    Wear(
        "amplifier", "amplifier -1 % a week", ("amplifier",), lambda days: Machine(amplifier=1.0 - 0.01 * days / WEEK)
    ),
    Wear("latency", "latency +36 µs by an update", ("host",), lambda days: Machine(slower=1.0)),
    Wear("bolt", "loose bolt, 0.5 µm", ("bolt",), lambda days: Machine(kink_um=0.5)),
)
