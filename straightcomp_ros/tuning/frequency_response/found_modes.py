"""The platform's resonances in a measured plant, with intervals.

The plant is fitted as that of a rigid platform of any gain, damping and stiffness with one mode after another:

    P ~ g C_e/(1 − (K̄_y − d s) C_c),   C_e = 1/(M s²) + (1/M) Σ r/(s² + 2ζωs + ω²),   r = φ_c φ_e

and C_c alike with |r|: a measurement from command to encoder hardly distinguishes φ_c from φ_e.

Each new mode begins where it explains most, over a grid of frequencies, and all are then fitted together, each line by
its confidence; once more from where they are described, since the fit of two that overlap has several minima. A mode
stays if an F test without the line that it explains best says that chance would explain as much in one of ten thousand
measurements. Between two lines a narrow mode shows by its flanks; its damping is then known worst, which the intervals
say.
"""

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import f as fisher

from straightcomp_ros.model.modes import LEAST_DAMPING, MOST_DAMPING
from straightcomp_ros.stage.description import StageParameters

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_CHANCE = 1e-4
_RIGID = 3
"""Numbers of the rigid platform in a fit: logarithms of gain and damping, and what its stiffness has more."""
_MOST = 2
"""Modes that a description has room for."""
_GRID = 400
_RESONATES = 0.5 * math.log(0.5)
"""Logarithm of the damping ratio below which a mode has a peak, as a resonance has: what is damped more is friction, or
the path."""
_FIRST_DAMPING = 0.02
_LEAST_RELATIVE = 0.01
"""Of a line's magnitude, which no line counts more than: a model is not the machine."""
_LEAST_COST = 0.25 / math.log(20.0)
"""For each number, of lines that are off by what their circle, or `_LEAST_RELATIVE`, says of 95 %."""
_FOLDED, _FOLDED_DAMPING = 0.002, 0.1
"""Of logarithms of frequency and damping: the mechanics are fitted unsampled, which puts a mode at 0.25 of the rate
up to 0.05 % off, and makes its damping 0.9 to 1.06 times as large."""


class Interval(NamedTuple):
    """A value and its interval of 95 %."""

    value: float
    low: float
    high: float

    def meets(self, other: "Interval") -> bool:
        """Whether a value may be in both."""
        return self.low <= other.high and other.low <= self.high

    def over(self, other: "Interval") -> "Interval":
        """The ratio of two positive values that are known independently of each other."""
        ratio = self.value / other.value
        wide = math.exp(math.hypot(*(math.log(one.high / one.value) for one in (self, other))))
        return Interval(ratio, ratio / wide, ratio * wide)


class FoundMode(NamedTuple):
    """A mode of a measured plant: frequency Hz, damping ratio, φ_c φ_e; and which described mode it is, '' if none."""

    frequency: Interval
    damping: Interval
    residue: Interval
    described: str

    @property
    def text(self) -> str:
        """The mode in words, and what to do about one that is not described."""
        f, z, r = self.frequency, self.damping, self.residue
        what = (
            f"{f.value:.1f} Hz ({f.low:.1f} to {f.high:.1f}), damping {z.value:.2g} ({z.low:.2g} to {z.high:.2g}), "
            f"φ_c φ_e {r.value:.2g} ({r.low:.2g} to {r.high:.2g})"
        )
        return f"mode at {what}: {self.described or 'in no description (stage.platform.modes)'}"

    def facts(self, name: str) -> dict[str, float]:
        """The mode as facts of a description, by dotted name under ``name`` (first, second)."""
        f, z, r = self.frequency, self.damping, self.residue
        seen = math.sqrt(abs(r.value))
        found = {
            "frequency": f.value,
            "damping": min(MOST_DAMPING, max(LEAST_DAMPING, z.value)),
            "coil": seen,
            "encoder": math.copysign(seen, r.value),
            "frequency_error": min(0.5, max(0.01, (f.high - f.low) / (2.0 * f.value))),
            "damping_factor": min(100.0, max(1.2, z.high / z.value)),
            "participation_error": min(0.9, max(0.1, (r.high - r.low) / (2.0 * abs(r.value)))),
        }
        return {f"platform.modes.{name}.{fact}": value for fact, value in found.items()}

    def to_display(self) -> dict[str, Any]:
        """The mode for JSON."""
        return {**{name: list(getattr(self, name)) for name in self._fields[:3]}, "described": self.described}


class FoundPlant(NamedTuple):
    """The mechanics of a measured plant: force over mass relative to the description, and the modes by rising
    frequency."""

    gain: Interval = Interval(1.0, 0.0, math.inf)
    modes: tuple[FoundMode, ...] = ()


def found_plant(
    frequencies: Array, plant: Complex, radius: Array, rigid: Complex, damping: float, stage: StageParameters
) -> FoundPlant:
    """What fits ``plant`` (lines,) in m/A, each line with its ``radius`` of confidence; ``rigid`` (lines,) is that of
    the stage without modes, whose friction is a ``damping`` in N·s/m. With few lines nothing is known.

    Where friction or the magnets outweigh the mass, what looks like a mode is friction, so that lines there do not
    count; a mode that lies there is a part of the gain.
    """
    mass, stiffness, damping = stage.platform.mass, stage.negative_stiffness, damping + stage.platform.damping
    slowest = max(damping / mass, math.sqrt(abs(stiffness) / mass))
    inertial = 2.0 * np.pi * frequencies > slowest
    frequencies, plant, radius, rigid = frequencies[inertial], plant[inertial], radius[inertial], rigid[inertial]
    if frequencies.size < 8:
        return FoundPlant()
    s = 2j * np.pi * frequencies
    weight = 1.0 / np.hypot(radius, _LEAST_RELATIVE * np.abs(plant))
    # The share of the plant that is its amplifier, its delay and its sampling, and no mechanics.
    path = rigid * (mass * s**2 + damping * s - stiffness)

    def modelled(p: Array) -> Complex:
        p = np.clip(p, -50.0, 50.0)  # A fit that runs away stays a number.
        at_coil = at_encoder = 1.0 / (mass * s**2)
        for k in range(_RIGID, p.size, 3):
            omega = 2.0 * math.pi * math.exp(p[k])
            mode = 1.0 / (mass * (s**2 + 2.0 * math.exp(p[k + 1]) * omega * s + omega**2))
            at_coil, at_encoder = at_coil + abs(p[k + 2]) * mode, at_encoder + p[k + 2] * mode
        pull = stiffness + p[2] * mass * slowest**2
        own = at_encoder / (1.0 - (pull - math.exp(p[1]) * damping * s) * at_coil)
        return np.asarray(math.exp(p[0]) * path * own)

    def misses(p: Array, counted: Array) -> Array:
        missed = counted * weight * (plant - modelled(p))
        return np.concatenate([missed.real, missed.imag])

    def fitted(begin: Sequence[float] | Array, counted: Array) -> Any:
        return least_squares(misses, begin, x_scale="jac", max_nfev=200, args=(counted,))

    lowest, highest = math.log(frequencies[0]), math.log(1.2 * frequencies[-1])

    def resonates(p: Array) -> bool:
        """Whether all modes have a peak, within the lines or not far above."""
        log_f, log_z = p[_RIGID::3], p[_RIGID + 1 :: 3]
        return bool(np.all((lowest < log_f) & (log_f < highest) & (log_z < _RESONATES)))

    every = np.ones(frequencies.size)
    grid = np.linspace(lowest, highest, _GRID)
    omegas = 2.0 * math.pi * np.exp(grid)[:, None]
    alone = weight * path / (mass * (s**2 + 2.0 * _FIRST_DAMPING * omegas * s + omegas**2))
    powers = np.sum(np.abs(alone) ** 2, axis=1)

    def with_another(modes: Array) -> Any:
        """The fit with a mode more, from where it explains most together with some gain of the others on the platform
        as described: a strong mode takes the gain of a rigid platform to nothing."""
        own = weight * modelled(np.array([*rigidly, *modes]))
        power, common = float(np.sum(np.abs(own) ** 2)), (alone.conj() @ own).real
        seen, seen_alone = float(np.sum((own.conj() * weight * plant).real)), (alone.conj() @ (weight * plant)).real
        both = power * powers - common**2
        gains, residues = (powers * seen - common * seen_alone) / both, (power * seen_alone - common * seen) / both
        k = int(np.where(gains > 0.0, gains * seen + residues * seen_alone, -np.inf).argmax())
        gain = max(float(gains[k]), 1e-20)  # Where none explains anything, the begin stays a number.
        another = grid[k], math.log(_FIRST_DAMPING), residues[k] / gain
        return fitted([math.log(gain), *rigidly[1:], *modes, *another], every)

    rigidly = (0.0,) * _RIGID
    best = fitted(rigidly, every)
    while best.x.size < _RIGID + 3 * _MOST and 2 * frequencies.size > best.x.size + 5:
        more = with_another(best.x[_RIGID:])
        if not resonates(more.x):
            break
        best = more
    if present := stage.platform.modes.present:
        described = [(math.log(mode.frequency), math.log(mode.damping), mode.residue) for mode in present]
        near = fitted([*best.x[:_RIGID], *chain(*described)], every)
        if resonates(near.x) and near.cost < best.cost:
            best = near

    def by_chance(fewer: Array, more: Any) -> bool:
        """Whether chance explains as much as a mode does: three numbers explain any one line, the others must speak."""
        explained = np.square(misses(fewer, every)) - np.square(misses(more.x, every))
        others = np.where(np.arange(frequencies.size) == explained.reshape(2, -1).sum(axis=0).argmax(), 0.0, 1.0)
        before, cost = fitted(fewer, others).cost, fitted(more.x, others).cost
        freedom = 2 * frequencies.size - 2 - more.x.size
        # What the model itself is off by is chance, too.
        left = max(_LEAST_COST, cost / freedom)
        return not (before - cost) / 3.0 / left >= fisher.ppf(1.0 - _CHANCE, 3, freedom)

    # Two modes are looked for before either is judged: what is left of the one would hide the other.
    while best.x.size > _RIGID:
        without = [fitted(np.delete(best.x, range(k, k + 3)), every) for k in range(_RIGID, best.x.size, 3)]
        fewer = min(without, key=lambda one: one.cost)
        if not by_chance(fewer.x, best):
            break
        best = fewer
    freedom = 2 * frequencies.size - best.x.size
    variance = np.diag(np.linalg.pinv(best.jac.T @ best.jac)) * 2.0 * best.cost / freedom
    # Of what the lines hardly determine, rounding may leave less than nothing.
    spread = np.minimum(2.0 * np.sqrt(np.where(variance > 0.0, variance, np.inf)), 10.0)

    def positive(place: int, model: float = 0.0) -> Interval:
        """What a logarithm says, which the ``model`` itself is off by."""
        log, half = best.x[place], math.hypot(spread[place], model)
        return Interval(*(math.exp(x) for x in (log, log - half, log + half)))

    places = range(_RIGID, best.x.size, 3)
    frequencies_found = [positive(k, _FOLDED) for k in places]
    found = []
    for k, frequency, name in zip(places, frequencies_found, _described(frequencies_found, stage), strict=True):
        r, dr = float(best.x[k + 2]), float(spread[k + 2])
        found.append(FoundMode(frequency, positive(k + 1, _FOLDED_DAMPING), Interval(r, r - dr, r + dr), name))
    return FoundPlant(positive(0), tuple(sorted(found)))


def _described(found: Sequence[Interval], stage: StageParameters) -> list[str]:
    """Which described mode each of the ``found`` frequencies is, '' if none: the nearest first, each mode once."""
    modes, pairs = stage.platform.modes, list[tuple[float, int, str]]()
    for name, mode in (("first", modes.first), ("second", modes.second)):
        if mode.frequency:
            low, high = ((1.0 + side * mode.frequency_error) * mode.frequency for side in (-1.0, 1.0))
            text, within = f"stage.platform.modes.{name}, {mode.frequency:g} Hz", Interval(mode.frequency, low, high)
            pairs += [(abs(f.value - mode.frequency), k, text) for k, f in enumerate(found) if f.meets(within)]
    names = [""] * len(found)
    for _, k, text in sorted(pairs):
        if not names[k] and text not in names:
            names[k] = text
    return names
