"""Stability of a law in the sampled loop: poles, gain range, phase margin, longest delay, frequency responses.

The law's own step function, the one that runs, is linearised by central differences about rest at the centre, and
closed over the sampled nominal plant with its command delay and the amplifier's lag. A law whose slope at rest is
infinite (sgn, super-twisting) has no linearisation and is refused.

A law may answer to the measured current of the coils too. As long as amplifier and delay are those of its own model,
the current is as predicted and carries no information: how much more or less force the loop endures is the same with
and without. How far off the amplifier's gain may be is another matter, because there the current contradicts the model.

Friction has no frequency response. While the platform slides to and fro with a velocity that is much like Gaussian
noise, it acts on the small components of the motion as a damping, its statistical linearisation E[v F(v)] / E[v²]
(A. Gelb and W. Vander Velde, Multiple-Input Describing Functions, 1968, chapter 7). That damping falls with velocity:
responses are comparable only between motions of the same velocity. At rest the bristles would instead act as a spring
of σ0, for motions that are far smaller than F_C/σ0, which is usually less than a count or two of the encoder.

The least margins with which the controller uses a law are less than a design demands (`tuning/design/stability.py`):
below them a small difference between the machine and its description makes the loop unstable. Each limit costs one set
of eigenvalues, because gains may change while the loop runs; how far the loop is stable is looked for only where a
limit is missed.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.law import Law, flat
from straightcomp_ros.control.laws import OPEN_LOOP, ControlParameters, described_state, make_law, states_of
from straightcomp_ros.model.friction import LuGreParameters
from straightcomp_ros.model.modes import off
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.stage.description import Factors, StageParameters, deviating

_STEPS = (1e-9, 1e-12)
"""Perturbations for the differences, in SI units: far below a count, far above rounding. The second where the first
leaves the stretch in which the law is linear, as the boundary layer of a fast 'smc'."""
_LINEAR_WITHIN = 1e-3

LEAST_GAINS = (0.8, 1.25)
"""Factors of the loop gain between which the law must be stable: 2 dB to each side."""
_STIFFEST_GAINS = (0.9, 1.1)
"""The same where the law is at its stiffest, which it leaves again when it has learned the friction."""
_STATES = {
    "quiet": ("", LEAST_GAINS),
    "stiff": (", at its stiffest", _STIFFEST_GAINS),
    "slow": (", with hardly any friction", LEAST_GAINS),
    "free": (", without friction", LEAST_GAINS),
}
"""By the law's state: the words of a refusal, and the factors."""
LEAST_PHASE = 5.0
"""Degrees."""
MECHANICS = ("mass", "force", "gap")
"""Facts of the uncertainty that change the plant without its drive."""
_FREQUENCIES = 400
_HARDLY, _TURNS = 0.1, 50
"""Damping below which a resonance is narrow on such a grid, whose steps are 2 %; and steps of its phase, 3.5° each."""
_HALVINGS = 10

Matrix = NDArray[np.float64]
Complex = NDArray[np.complex128]


class NotLinear(ValueError):
    """A law has no linearisation at rest, and so no linear margins or responses: verbs print it as a sentence."""


class StateSpace(NamedTuple):
    """x⁺ = A x + B u, out = C x + D u: a (n, n), b (n, inputs), c (outputs, n), d (outputs, inputs)."""

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix


class Margins(NamedTuple):
    """How far the loop is from instability.

    Attributes:
        poles: of the closed loop, in the z plane.
        gain_low, gain_high: factors of the loop gain between which it is stable; the open-loop plant is unstable.
        phase: smallest phase margin over all gain crossovers, degrees.
        longest_delay: command delay in s up to which it is stable.
    """

    poles: Complex
    gain_low: float
    gain_high: float
    phase: float
    longest_delay: float


@dataclass(frozen=True, eq=False)
class LoopResponse:
    """Responses at some frequencies, (lines,) each.

    Attributes:
        plant: from command to reading, m/A.
        open_loop: from command to what the law answers to it, with its sign turned: −1 is the critical point.
        sensitivity: from a disturbance of the command to the command.
    """

    plant: Complex
    open_loop: Complex
    sensitivity: Complex


def sampled_plant(stage: StageParameters, delay: float | None = None, damping: float = 0.0) -> StateSpace:
    """From commanded current (A) to position (m) and current of the coils (A): the linear plant (3), sampled.

    ``delay`` is that of a command from its sample in s, zero or more, by default as described; ``damping`` that of the
    platform's motion in N·s/m: friction otherwise is left out.
    """
    delay = stage.delay if delay is None else delay
    # SciPy takes half of the time that a node needs to start, and most nodes need none of it.
    from scipy.linalg import expm

    actuator, mass, period = stage.actuator, stage.platform.mass, stage.period
    rate, modes = 2.0 * math.pi * stage.drive.bandwidth, stage.platform.modes.present
    # State: y, ẏ, i, each mode's q and q̇; then the commands that have not acted yet, the oldest first.
    own = 3 + 2 * len(modes)
    continuous = np.zeros((own + 1, own + 1))
    at_coil, at_encoder = np.zeros((2, own + 1))
    at_coil[0] = at_encoder[0] = 1.0
    driven = np.zeros(own + 1)
    driven[1] = 1.0
    continuous[0, 1] = 1.0
    for number, mode in enumerate(modes):
        q, omega = 3 + 2 * number, 2.0 * math.pi * mode.frequency
        at_coil[q], at_encoder[q], driven[q + 1] = mode.coil, mode.encoder, mode.coil
        continuous[q, q + 1] = 1.0
        continuous[q + 1, q : q + 2] = -omega * omega, -2.0 * mode.damping * omega
    # Forces act where the coils are: the magnets' by place and current, the damping by velocity.
    force = stage.negative_stiffness * at_coil
    force -= (damping + stage.platform.damping) * np.roll(at_coil, 1)
    force[2] = actuator.current_stiffness
    continuous += np.outer(driven, force) / mass
    continuous[2, 2], continuous[2, own] = -rate, rate
    whole = int(delay / period)
    rest = delay - whole * period
    with_old, with_new = expm(continuous * rest), expm(continuous * (period - rest))
    n = own + 1 + whole
    a, b, c = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((2, n))
    a[:own, :own] = with_new[:own, :own] @ with_old[:own, :own]
    a[:own, own] = with_new[:own, :own] @ with_old[:own, own]
    if whole:
        a[:own, own + 1] = with_new[:own, own]
    else:
        b[:own, 0] = with_new[:own, own]
    for place in range(own, n - 1):
        a[place, place + 1] = 1.0
    b[n - 1] = 1.0
    c[0, :own], c[1, 2] = at_encoder[:own], 1.0
    return StateSpace(a, b, c, np.zeros((2, 1)))


def with_modes_off(stage: StageParameters) -> dict[str, StageParameters]:
    """The stage with its modes at the ends of their uncertainty, least damped and most seen, by a name in words; empty
    without modes. All modes are off to the same side, or to opposite ones."""
    present, found = stage.platform.modes.present, {}
    for sides in itertools.product((-1.0, 0.0, 1.0), repeat=len(present)) if present else ():
        modes = [off(mode, side, -1.0, 1.0) for mode, side in zip(present, sides, strict=True)]
        name = ", ".join(f"{mode.frequency:.0f} Hz" for mode in modes)
        found[name] = stage.with_modes(*modes)
    return found


def with_facts_off(
    stage: StageParameters, facts: Sequence[str] = MECHANICS, *, possible: bool = False
) -> dict[str, StageParameters]:
    """The stage at all corners of what it leaves open of ``facts``, by a name in words; ParameterError if one is
    impossible, or with ``possible`` without those."""
    ranges = stage.uncertainty
    sides = {
        "mass": (1.0 - ranges.mass, 1.0 + ranges.mass),
        "force": (1.0 - ranges.force, 1.0 + ranges.force),
        "gap": (1.0 - ranges.air_gap, 1.0 + ranges.air_gap),
        "amplifier": (1.0 / ranges.amplifier, ranges.amplifier),
        "delay": (min(1.0, ranges.shortest_delay), max(1.0, ranges.longest_delay)),
    }
    found = {}
    for factors in itertools.product(*(sorted(set(sides[fact])) for fact in facts)):
        at = dict(zip(facts, factors, strict=True))
        machine = Factors(at["mass"], at["force"], at["gap"], amplifier=at.get("amplifier", 1.0))
        name = ", ".join(f"{fact} × {factor:g}" for fact, factor in at.items())
        with suppress(*((ParameterError,) if possible else ())):
            plant = deviating(stage.plant, machine)
            drive = replace(plant.drive, delay=at.get("delay", 1.0) * stage.drive.delay)
            found[name] = replace(stage, platform=plant.platform, actuator=plant.actuator, drive=drive)
    return found


def linearised(law: Law, *, with_current: bool = False) -> StateSpace:
    """From reading (m) to commanded current (A): the law about rest at the centre, with the reference at zero.

    All numbers of its state are zero there: 'smc_observer' is taken without friction. States that no input reaches, or
    that do not act on the command, are left out. With ``with_current`` the measured current of the coils (A) is a
    second input; otherwise none is measured.

    Raises:
        NotLinear: the law is not linear there.
    """
    inputs, size = (2 if with_current else 1), len(flat(law.start(0.0)))
    for step in _STEPS:
        columns, coarser = (_slopes_at_rest(law, inputs, size, one) for one in (step, 2.0 * step))
        # A clock or a paused fit is a pole on the unit circle, but not in the loop. Nor is a dither, which bends.
        all_a, all_b, all_c = columns[:size, :size], columns[:size, size:], columns[size:, :size]
        looped = np.flatnonzero(_connected(all_a, all_c) & _connected(all_a.T, all_b.T))
        kept = np.ix_([*looped, size], [*looped, *range(size, size + inputs)])
        if np.allclose(columns[kept], coarser[kept], rtol=_LINEAR_WITHIN, atol=0.0):
            return StateSpace(all_a[np.ix_(looped, looped)], all_b[looped], all_c[:, looped], columns[size:, size:])
    raise NotLinear(
        "this law has no linearisation at rest: its slope there depends on the step; smc has one with a "
        "'control.smc.boundary_layer' above 0"
    )


def _slopes_at_rest(law: Law, inputs: int, size: int, step: float) -> Matrix:
    """Derivatives (``size`` states + 1, states + inputs) of next state and command by state and inputs, about rest at
    zero, by differences of ``step`` to both sides.

    The first input is the reading. The second is the measured current; with one input, none is measured.
    """

    def disturbed(place: int, by: float) -> Matrix:
        numbers = [0.0] * (size + 1) + ([0.0] if inputs > 1 else [math.nan])
        numbers[place] = by
        after, command = law.answer_from(numbers[:size], *numbers[size:])
        return np.array([*after, command.current])

    places = range(size + inputs)
    return np.array([(disturbed(place, step) - disturbed(place, -step)) / (2.0 * step) for place in places]).T


def _connected(a: Matrix, c: Matrix) -> NDArray[np.bool_]:
    """Whether any output depends on each state, through others too."""
    seen: NDArray[np.bool_] = np.any(c != 0.0, axis=0)
    for _ in range(len(a)):
        seen |= np.any(a[seen] != 0.0, axis=0)
    return seen


def closed_loop(plant: StateSpace, controller: StateSpace, gain: float = 1.0) -> Matrix:
    """A of the closed loop, the plant's states first, with the plant's input times ``gain``.

    The controller takes as many of the plant's outputs as it has inputs.
    """
    b, seen = gain * plant.b, plant.c[: controller.b.shape[1]]
    return np.block([[plant.a + b @ controller.d @ seen, b @ controller.c], [controller.b @ seen, controller.a]])


def spectral_radius(matrix: Matrix) -> float:
    """Largest magnitude of an eigenvalue: a sampled loop is stable below 1."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def _stable(plant: StateSpace, controller: StateSpace, gain: float = 1.0) -> bool:
    return spectral_radius(closed_loop(plant, controller, gain)) < 1.0


def loop_margins(law: Law, stage: StageParameters, *, with_current: bool = False) -> Margins:
    """Margins of ``law`` on the plant of ``stage``.

    ``with_current`` as of :func:`linearised`: the gain is then the amplifier's, otherwise just as well the force's.

    Raises:
        NotLinear: the law has no linearisation at rest.
    """
    late, period = stage.delay, stage.period
    plant, linear = sampled_plant(stage), linearised(law, with_current=with_current)
    poles = np.asarray(np.linalg.eigvals(closed_loop(plant, linear)), dtype=np.complex128)
    if not np.abs(poles).max() < 1.0:
        return Margins(poles, 1.0, 1.0, 0.0, 0.0)
    return Margins(
        poles,
        last_stable(partial(_stable, plant, linear), 1.0, 0.0),
        last_stable(partial(_stable, plant, linear), 1.0, 20.0),
        phase_margin(plant, linear, period),
        last_stable(lambda late: _stable(sampled_plant(stage, late), linear), late, late + 10.0 * period),
    )


AS_DESCRIBED = "as described"


def unstable_where(control: ControlParameters, stage: StageParameters) -> str:
    """Where the law, as it is on ``stage``, is unstable, in words: :data:`AS_DESCRIBED`, or else at the first corner of
    :func:`with_facts_off`; empty if nowhere, if it has no linearisation at rest, or if there is no law. Impossible
    corners do not count."""
    if control.law == OPEN_LOOP:
        return ""
    try:
        linear = linearised(make_law(described_state(control, stage)[1], stage))
        if not _stable(sampled_plant(stage), linear):
            return AS_DESCRIBED
    except NotLinear:
        return ""
    corners = with_facts_off(stage, possible=True)
    return next((name for name, one in corners.items() if not _stable(sampled_plant(one), linear)), "")


def last_stable(stable: Callable[[float], bool], inside: float, outside: float) -> float:
    """The last stable value on the way from ``inside``, which is stable, to ``outside``."""
    # In small steps first: beyond the border there may be another stable stretch.
    last = inside
    for value in np.linspace(inside, outside, 100)[1:].tolist():
        if not stable(value):
            return bisected(stable, last, value, halvings=40)
        last = value
    return outside


def bisected(stable: Callable[[float], bool], inside: float, outside: float, halvings: int = _HALVINGS) -> float:
    """Where what holds ``inside`` and not ``outside`` ends: the last value at which it holds, by bisection."""
    for _ in range(halvings):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if stable(middle) else (inside, middle)
    return inside


def phase_margin(plant: StateSpace, controller: StateSpace, period: float, frequencies: int = 5_000) -> float:
    """Smallest phase margin over all gain crossovers in degrees, found on a grid of ``frequencies``, and about each
    resonance and notch that may cross twice between two of them."""
    grid = np.geomspace(0.1, 0.4999 / period, frequencies)
    if (sharp := _resonances(plant, controller, period)).size:
        grid = np.unique(np.concatenate([grid, sharp[(sharp > grid[0]) & (sharp < grid[-1])]]))
    loop = _open_loop(plant, controller, np.exp(2j * math.pi * grid * period))
    magnitude = np.abs(loop)
    crossing = np.flatnonzero((magnitude[:-1] - 1.0) * (magnitude[1:] - 1.0) <= 0.0)
    margins = np.abs(np.degrees(np.angle(-loop[crossing])))
    return float(margins.min()) if len(margins) else 180.0


def _resonances(plant: StateSpace, controller: StateSpace, period: float) -> Matrix:
    """Frequencies (n,) in Hz about those of the poles that are hardly damped: f (1 + ζ tan θ) with θ in equal steps, in
    which a resonance turns its phase."""
    poles = np.concatenate([np.linalg.eigvals(system.a) for system in (plant, controller)])
    rates = np.log(poles[poles.imag > 0.0])
    rates = rates[-rates.real < _HARDLY * np.abs(rates)]
    turns = np.tan(np.linspace(-0.49, 0.49, _TURNS) * math.pi)
    return np.asarray((rates.imag + np.outer(turns, rates.real)).ravel() / (2.0 * math.pi * period))


def _open_loop(plant: StateSpace, controller: StateSpace, z: Complex) -> Complex:
    """From command to what the controller answers to it, its sign turned, at the points ``z`` (n,): (n,)."""
    seen = _response(plant, z)[:, : controller.b.shape[1]]
    return -(_response(controller, z) @ seen)[:, 0, 0]


def _response(system: StateSpace, z: Complex) -> Complex:
    """Outputs per input of ``system`` at the points ``z`` (n,) of the z plane, (n, outputs, inputs)."""
    # A stack of one: NumPy 1 takes a matrix next to a stack of matrices for a stack of vectors.
    solved = np.linalg.solve(z[:, None, None] * np.eye(len(system.a)) - system.a, system.b[None])
    return np.asarray(system.c @ solved + system.d)


def friction_damping(friction: LuGreParameters, speed: float) -> float:
    """Damping in N·s/m that friction equals, at an RMS velocity ``speed`` > 0 in m/s that is Gaussian."""
    stribeck = friction.stribeck_velocity**2 / (friction.stribeck_velocity**2 + 2.0 * speed**2)
    sliding = friction.coulomb + (friction.static - friction.coulomb) * stribeck
    return friction.viscous + math.sqrt(2.0 / math.pi) * sliding / speed


def loop_response(law: Law, stage: StageParameters, frequencies: Matrix, damping: float = 0.0) -> LoopResponse:
    """Plant and loop of ``law``, whose own friction model is left out, on ``stage``, at ``frequencies`` (lines,) in Hz.

    The platform's motion has a ``damping`` in N·s/m. The law also answers to the measured current, on which command and
    plant act as on the position.

    Raises:
        NotLinear: the law has no linearisation at rest.
    """
    plant = sampled_plant(stage, damping=damping)
    z = np.exp(2j * math.pi * frequencies * stage.period)
    loop = _open_loop(plant, linearised(law, with_current=True), z)
    return LoopResponse(_response(plant, z)[:, 0, 0], loop, 1.0 / (1.0 + loop))


def missing_margin(control: ControlParameters, stage: StageParameters) -> str | None:
    """What the law of ``control`` lacks on ``stage``: a sentence with parameters, value, limit and remedy.

    None if it has the least margins, if it has no linearisation at rest and so no linear margins, or if it is none.
    """
    if control.law == OPEN_LOOP:
        return None
    try:
        missed = next(_missed(control, stage), None)
    except NotLinear:
        return None
    if missed is None:
        return None
    # A law has its own group of gains; 'linear' is 'smc' without its switching.
    group = control.law if hasattr(control, control.law) else "smc"
    return (
        f"parameters 'control.{group}.*': on stage '{stage.name}' at {stage.rate} Hz with commands "
        f"{stage.drive.delay:g} samples late, the law '{control.law}' {missed}; "
        "straightcomp design finds gains for a stage"
    )


def _missed(control: ControlParameters, stage: StageParameters) -> Iterator[str]:
    """Each limit that the law misses, in words; NotLinear if the law has no linearisation at rest."""
    plant = sampled_plant(stage)
    laws = {state: make_law(one, stage) for state, one in states_of(control, stage).items()}
    for state, law in laws.items():
        where, gains = _STATES[state]
        for measured, how in ((False, ""), (True, ", with the coils' current measured")):
            stable = partial(_stable, plant, linearised(law, with_current=measured))
            yield from _gains_missed(stable, f"{where}{how}," if where or how else "", gains)
        for modes, machine in with_modes_off(stage).items():
            if not _stable(sampled_plant(machine), linearised(law)):
                yield f"is{where} unstable with the platform's modes at {modes}, within 'stage.platform.modes'"
    linear, period = linearised(laws["quiet"]), stage.period
    latest = stage.drive.delay * max(1.0, stage.uncertainty.longest_delay)

    def stable_at(samples: float) -> bool:
        return _stable(sampled_plant(stage, samples * period), linear)

    if not stable_at(latest):
        longest = bisected(stable_at, stage.drive.delay, latest)
        yield (
            f"is stable with commands up to {longest:.2f} samples late; allowed: >= {latest:g}, "
            "stage.drive.delay × stage.uncertainty.longest_delay"
        )
    phase = phase_margin(plant, linear, period, _FREQUENCIES)
    if phase < LEAST_PHASE:
        yield f"has a phase margin of {phase:.1f}°; allowed: >= {LEAST_PHASE:g}°"


def _gains_missed(stable: Callable[[float], bool], where: str, gains: tuple[float, float]) -> Iterator[str]:
    low, high = gains
    if not stable(1.0):
        yield f"is{where} unstable; allowed: stable from {low:g} to {high:g} times its loop gain"
        return
    for limit, direction, allowed in ((low, "down", "<="), (high, "up", ">=")):
        if not stable(limit):
            border = bisected(stable, 1.0, limit)
            yield f"is{where} stable {direction} to {border:.2f} times its loop gain; allowed: {allowed} {limit:g}"
