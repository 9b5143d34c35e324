"""Stability of a law in the sampled loop: poles, gain range, phase margin, longest delay.

The law's own step function, the one that runs, is linearised by central differences about rest at the centre, and
closed over the sampled nominal plant with its command delay and the amplifier's lag. A law whose slope at rest is
infinite (sgn, super-twisting) has no linearisation and is refused.

A law may answer to the measured current of the coils too. As long as amplifier and delay are those of its own model,
the current is as predicted and tells it nothing: how much more or less force it endures is the same with and without.
How far off the amplifier's gain may be is another matter, because there the current contradicts the model.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from straightcomp_ros.control.law import Law, flat
from straightcomp_ros.stage.description import StageParameters

_STEPS = (1e-9, 1e-12)
"""Perturbations for the differences, in SI units: far below a count, far above rounding. The second where the first
leaves the stretch in which the law is linear, as the boundary layer of a fast 'smc'."""
_LINEAR_WITHIN = 1e-3

Matrix = NDArray[np.float64]


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

    poles: NDArray[np.complex128]
    gain_low: float
    gain_high: float
    phase: float
    longest_delay: float


def sampled_plant(stage: StageParameters, delay: float, damping: float = 0.0) -> StateSpace:
    """From commanded current (A) to position (m) and current of the coils (A): the linear plant (3), sampled.

    Args:
        stage: whose plant, rate and amplifier are taken.
        delay: of a command from its sample, s, zero or more.
        damping: of the platform's motion, N·s/m; friction otherwise is left out.
    """
    actuator, mass, period = stage.actuator, stage.platform.mass, stage.period
    rate = 2.0 * math.pi * stage.drive.bandwidth
    continuous = np.zeros((4, 4))
    continuous[0, 1] = 1.0
    continuous[1, 0] = actuator.position_stiffness / mass
    continuous[1, 1] = -damping / mass
    continuous[1, 2] = actuator.current_stiffness / mass
    continuous[2, 2], continuous[2, 3] = -rate, rate
    whole = int(delay / period)
    rest = delay - whole * period
    with_old, with_new = expm(continuous * rest), expm(continuous * (period - rest))
    # State: y, ẏ, i, then the commands that have not acted yet, the oldest first.
    n = 4 + whole
    a, b, c = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((2, n))
    a[:3, :3] = with_new[:3, :3] @ with_old[:3, :3]
    a[:3, 3] = with_new[:3, :3] @ with_old[:3, 3]
    if whole:
        a[:3, 4] = with_new[:3, 3]
    else:
        b[:3, 0] = with_new[:3, 3]
    for place in range(3, n - 1):
        a[place, place + 1] = 1.0
    b[n - 1] = 1.0
    c[0, 0] = c[1, 2] = 1.0
    return StateSpace(a, b, c, np.zeros((2, 1)))


def linearised(law: Law, *, with_current: bool = False) -> StateSpace:
    """From reading (m) to commanded current (A): the law about rest at the centre, with the reference at zero.

    All numbers of its state are zero there: 'smc_observer' is taken without friction. States that no input reaches, or
    that do not act on the command, are left out.

    Args:
        law: the law.
        with_current: whether the measured current of the coils (A) is a second input. Otherwise none is measured.

    Raises:
        ValueError: the law is not linear there.
    """
    columns = _slopes_at_rest(law, inputs=2 if with_current else 1)
    size = len(columns) - 1
    # A clock or a paused fit would be a pole on the unit circle, though it is not in the loop.
    all_a, all_b, all_c = columns[:size, :size], columns[:size, size:], columns[size:, :size]
    looped = np.flatnonzero(_connected(all_a, all_c) & _connected(all_a.T, all_b.T))
    return StateSpace(all_a[np.ix_(looped, looped)], all_b[looped], all_c[:, looped], columns[size:, size:])


def _slopes_at_rest(law: Law, inputs: int) -> Matrix:
    """Derivatives (states + 1, states + inputs) of next state and command by state and inputs, about rest at zero.

    The first input is the reading. The second is the measured current; with one input, none is measured.
    """
    size = len(flat(law.start(0.0)))

    def disturbed(place: int, step: float) -> Matrix:
        numbers = [0.0] * (size + inputs)
        numbers[place] = step
        current = numbers[size + 1] if inputs > 1 else math.nan
        after, command = law.answer_from(numbers[:size], numbers[size], current)
        return np.array([*after, command.current])

    def slopes(step: float) -> Matrix:
        places = range(size + inputs)
        return np.array([(disturbed(place, step) - disturbed(place, -step)) / (2.0 * step) for place in places]).T

    for step in _STEPS:
        columns, coarser = slopes(step), slopes(2.0 * step)
        if np.allclose(columns, coarser, rtol=_LINEAR_WITHIN, atol=_LINEAR_WITHIN * float(np.abs(columns).min())):
            return columns
    raise ValueError("this law has no linearisation at rest: its slope there depends on the step")


def _connected(a: Matrix, c: Matrix) -> NDArray[np.bool_]:
    """Whether any output depends on each state, through others too."""
    seen: NDArray[np.bool_] = np.any(c != 0.0, axis=0)
    for _ in range(len(a)):
        seen |= np.any(a[seen] != 0.0, axis=0)
    return seen


def loop_margins(
    law: Law, stage: StageParameters, delay: float | None = None, *, with_current: bool = False
) -> Margins:
    """Margins of ``law`` on the plant of ``stage``, with commands ``delay`` s late: by default as described.

    ``with_current`` as of :func:`linearised`: the gain is then the amplifier's, otherwise just as well the force's.

    Raises:
        ValueError: the law has no linearisation at rest.
    """
    controller, period = linearised(law, with_current=with_current), stage.period
    late = stage.drive.delay * period if delay is None else delay

    def plant(at: float = late) -> StateSpace:
        return sampled_plant(stage, at)

    def poles(gain: float = 1.0, at: float = late) -> NDArray[np.complex128]:
        return np.asarray(np.linalg.eigvals(closed_loop(plant(at), controller, gain)), dtype=np.complex128)

    def stable(gain: float = 1.0, at: float = late) -> bool:
        return spectral_radius(closed_loop(plant(at), controller, gain)) < 1.0

    if not stable():
        return Margins(poles(), 1.0, 1.0, 0.0, 0.0)
    return Margins(
        poles(),
        last_stable(stable, 1.0, 0.0),
        last_stable(stable, 1.0, 20.0),
        phase_margin(plant(), controller, period),
        last_stable(lambda x: stable(at=x), late, late + 10.0 * period),
    )


def closed_loop(plant: StateSpace, controller: StateSpace, gain: float = 1.0) -> Matrix:
    """A of the closed loop, the plant's states first, with the plant's input times ``gain``.

    The controller takes as many of the plant's outputs as it has inputs.
    """
    b, seen = gain * plant.b, plant.c[: controller.b.shape[1]]
    return np.block([[plant.a + b @ controller.d @ seen, b @ controller.c], [controller.b @ seen, controller.a]])


def spectral_radius(matrix: Matrix) -> float:
    """Largest magnitude of an eigenvalue: a sampled loop is stable below 1."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def last_stable(stable: Callable[[float], bool], inside: float, outside: float) -> float:
    """The last stable value on the way from ``inside``, which is stable, to ``outside``."""
    # In small steps first: beyond the border there may be another stable stretch.
    last = inside
    for value in np.linspace(inside, outside, 100)[1:].tolist():
        if not stable(value):
            outside = value
            break
        last = value
    else:
        return outside
    for _ in range(40):
        middle = 0.5 * (last + outside)
        last, outside = (middle, outside) if stable(middle) else (last, middle)
    return last


def phase_margin(plant: StateSpace, controller: StateSpace, period: float, frequencies: int = 5_000) -> float:
    """Smallest phase margin over all gain crossovers in degrees, found on a grid of ``frequencies``."""
    grid = np.geomspace(0.1, 0.4999 / period, frequencies)
    loop = open_loop(plant, controller, np.exp(2j * math.pi * grid * period))
    magnitude = np.abs(loop)
    crossing = np.flatnonzero((magnitude[:-1] - 1.0) * (magnitude[1:] - 1.0) <= 0.0)
    margins = np.abs(np.degrees(np.angle(-loop[crossing])))
    return float(margins.min()) if len(margins) else 180.0


def open_loop(plant: StateSpace, controller: StateSpace, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """From command to what the controller answers to it, its sign turned, at the points ``z`` (n,): (n,)."""
    seen = response(plant, z)[:, : controller.b.shape[1]]
    return -(response(controller, z) @ seen)[:, 0, 0]


def response(system: StateSpace, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Outputs per input of ``system`` at the points ``z`` (n,) of the z plane, (n, outputs, inputs)."""
    solved = np.linalg.solve(z[:, None, None] * np.eye(len(system.a)) - system.a, system.b)
    return np.asarray(system.c @ solved + system.d)
