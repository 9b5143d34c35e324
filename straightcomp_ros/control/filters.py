"""Filters in the loop, behind every law: notches and a roll-off for resonances, oscillators for the mains.

    i = L(z) N_1(z) N_2(z) i_law + Σ h_n

A notch is (s² + 2 d ζ ω s + ω²)/(s² + 2 ζ ω s + ω²), with the width 2 ζ and the depth d; its poles may lie at another ω
than its zeros, at p times it, so that what it costs in phase below its frequency becomes gain above it. The roll-off is
a low-pass of second order. All are sampled by Tustin's rule with each ω kept, and 1 at frequency zero. A law with an
observer gives it the filtered command: it predicts what truly acts, so that only the law waits for the filters, and its
observer does not.

An oscillator h_n turns by its angular frequency from sample to sample and is driven by the error y − r:

    h⁺ = e^{jωT} (h + g e),   i gains Re h

It has all gain at its frequency, where it leaves no error (internal model principle, Francis and Wonham, Automatica
12(5), 1976). Its complex gain g turns the pole that it adds to the closed loop straight into the unit circle, as far as
its width says: |g| is the width over the loop's answer to h, and its angle makes up for the angle of that answer.
"""

import cmath
import math
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import group, parameter

_HIGHEST = 0.45
"""Of the rate: highest frequency of a filter."""
_LEAK = 0.02
"""Of the width: an oscillator forgets so much faster than an ideal one, so that nothing stays for ever."""


@dataclass(frozen=True)
class NotchParameters:
    """One notch."""

    frequency: float = parameter(0.0, "Frequency; 0: no notch", "[0, 10000] Hz")
    width: float = parameter(0.5, "Width relative to the frequency", "[0.001, 10]")
    depth: float = parameter(0.05, "Gain at the frequency, of a notch whose poles are there", "[0, 1]")
    poles: float = parameter(1.0, "Frequency of the poles relative to that of the notch", "[0.2, 5]")


@dataclass(frozen=True)
class RollOffParameters:
    """A low-pass of second order."""

    frequency: float = parameter(0.0, "Corner frequency; 0: no roll-off", "[0, 10000] Hz")
    damping: float = parameter(0.7, "Damping ratio", "[0.1, 2]")


@dataclass(frozen=True)
class HumParameters:
    """What takes the mains out of the error."""

    frequency: float = parameter(0.0, "Frequency of the mains; 0: nothing is done", "[0, 1000] Hz")
    multiples: int = parameter(1, "How many multiples of it, itself the first, are taken out", "[1, 3]")
    width: float = parameter(4.0, "How fast, and for how wide a line: bandwidth of each oscillator", "[0.01, 50] Hz")


@dataclass(frozen=True)
class FilterParameters:
    """Filters in the loop; none by default."""

    first: NotchParameters = group(NotchParameters, "First notch of the loop")
    second: NotchParameters = group(NotchParameters, "Second notch of the loop")
    roll_off: RollOffParameters = group(RollOffParameters, "Roll-off of the loop")
    mains: HumParameters = group(HumParameters, "Rejection of the mains")


class Section(NamedTuple):
    """(b0 + b1 z⁻¹ + b2 z⁻²)/(1 + a1 z⁻¹ + a2 z⁻²)."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


class Oscillator(NamedTuple):
    """e^{jωT} with its leak, and g in A/m."""

    cosine: float
    sine: float
    real: float
    imaginary: float


class Filters(NamedTuple):
    """All filters of a loop; ``active`` is 0 without any."""

    active: float
    first: Section
    second: Section
    roll_off: Section
    hum_1: Oscillator
    hum_2: Oscillator
    hum_3: Oscillator


class Pair(NamedTuple):
    """State of a section, A, or of an oscillator."""

    a: float
    b: float


class Memory(NamedTuple):
    """State of all filters."""

    first: Pair
    second: Pair
    roll_off: Pair
    hum_1: Pair
    hum_2: Pair
    hum_3: Pair


_THROUGH = Section(1.0, 0.0, 0.0, 0.0, 0.0)
_SILENT = Oscillator(0.0, 0.0, 0.0, 0.0)
NONE = Filters(0.0, *(_THROUGH,) * 3, *(_SILENT,) * 3)
"""No filters."""
EMPTY = Memory(*(Pair(0.0, 0.0),) * 6)
"""Nothing filtered yet."""


def _section(
    frequency: float, period: float, numerator: tuple[float, float], damping: float, poles: float = 1.0
) -> Section:
    """(p s² + q ω s + ω²)/(s² + 2 ζ ω s + ω²) with (p, q) the ``numerator``, sampled, and 1 at frequency zero; ω of the
    denominator is ``poles`` times that, at most `_HIGHEST`. As it is from there on, where nothing is left to filter."""
    if not 0.0 < frequency * period < _HIGHEST:
        return _THROUGH
    k = math.tan(math.pi * frequency * period)
    m = math.tan(min(math.pi * (poles * frequency) * period, math.pi * _HIGHEST))
    p, q = numerator
    gain, scale = (m / k) ** 2, 1.0 + 2.0 * damping * m + m * m
    return Section(
        gain * (p + q * k + k * k) / scale,
        gain * 2.0 * (k * k - p) / scale,
        gain * (p - q * k + k * k) / scale,
        2.0 * (m * m - 1.0) / scale,
        (1.0 - 2.0 * damping * m + m * m) / scale,
    )


def _turn(mains: HumParameters, number: int, period: float) -> complex:
    """e^{jωT} with its leak, of oscillator ``number``, from 0."""
    kept = math.exp(-2.0 * math.pi * _LEAK * mains.width * period)
    return kept * cmath.exp(2j * math.pi * (number + 1) * mains.frequency * period)


def filters_of(parameters: FilterParameters, period: float, gains: tuple[complex, ...] = ()) -> Filters:
    """The filters, sampled; ``gains`` are those of the oscillators in A/m, as :func:`turned_gain` gives them."""
    notches = [
        _section(one.frequency, period, (1.0, one.depth * one.width), 0.5 * one.width, one.poles)
        for one in (parameters.first, parameters.second)
    ]
    roll_off = _section(parameters.roll_off.frequency, period, (0.0, 0.0), parameters.roll_off.damping)
    hums = [_SILENT] * 3
    for n, gain in enumerate(gains):
        turn = _turn(parameters.mains, n, period)
        hums[n] = Oscillator(turn.real, turn.imag, gain.real, gain.imag)
    active = any(one != _THROUGH for one in (*notches, roll_off)) or bool(gains)
    return Filters(float(active), notches[0], notches[1], roll_off, *hums)


def oscillators_of(parameters: FilterParameters, rate: float) -> int:
    """How many oscillators there are below `_HIGHEST` of the ``rate``, Hz."""
    mains = parameters.mains
    return sum(0.0 < n * mains.frequency < _HIGHEST * rate for n in range(1, mains.multiples + 1))


def turned_gain(parameters: FilterParameters, number: int, period: float, tried: float, pole: complex) -> complex:
    """The gain of oscillator ``number``, from 0, given that a ``tried`` small one puts its ``pole`` there."""
    # To first order the pole moves by c g; it is to move straight inward.
    moved = (pole / _turn(parameters.mains, number, period) - 1.0) / tried
    return -2.0 * math.pi * parameters.mains.width * period / moved


@compilable
def _through(s: Section, m: Pair, x: float) -> tuple[float, Pair]:
    y = s.b0 * x + m.a
    return y, Pair(s.b1 * x - s.a1 * y + m.b, s.b2 * x - s.a2 * y)


@compilable
def _turned(o: Oscillator, m: Pair, error: float) -> Pair:
    a, b = m.a + o.real * error, m.b + o.imaginary * error
    return Pair(o.cosine * a - o.sine * b, o.sine * a + o.cosine * b)


@compilable
def filtered(f: Filters, m: Memory, asked: float, error: float) -> tuple[float, Memory]:
    """The current for the one that a law ``asked`` for, A, and the memory with this sample; ``error`` is y − r in m,
    0 while the law does not act on it."""
    if f.active == 0.0:
        return asked, m
    current, first = _through(f.first, m.first, asked)
    current, second = _through(f.second, m.second, current)
    current, roll_off = _through(f.roll_off, m.roll_off, current)
    one, two = _turned(f.hum_1, m.hum_1, error), _turned(f.hum_2, m.hum_2, error)
    three = _turned(f.hum_3, m.hum_3, error)
    return current + (one.a + two.a + three.a), Memory(first, second, roll_off, one, two, three)
