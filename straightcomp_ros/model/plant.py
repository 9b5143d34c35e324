"""The platform in Y: M ÿ = f_c − F_friction − k y − c ẏ (1), between mechanical stops, behind the power amplifier and
its board. k and c are those of a flexure that guides the platform; there is none in the paper.

Fixed substeps by Strang splitting (half a kick, drift, exact bristle step, half a kick): second order, symplectic
without friction. The bristle's step is exact, so that sliding is never stiff; a stuck platform on its bristles is an
oscillator, and bristles that are stiff for the mass shorten the substep. The inertial force of the guide's deviation,
M δ̈, stays below 5 mN (a fifth of a D/A step) and is left out, as in (1).

Between two samples of its board, commands take effect at their times, and a late one is bridged: the board holds the
platform until it comes. It applies the mean of the commands before, which balances the magnets' pull at that place. It
takes back the impulse that the last commands gave beyond that mean: each answers an error of its own moment, and the
commands after it would have undone it. It adds a stiffness about the last reading, since the magnets' own is negative.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.actuator import Actuator, ActuatorParameters, magnetic_force
from straightcomp_ros.model.compiled import compilable, compiled
from straightcomp_ros.model.converters import DriveParameters, EncoderParameters, nearest_count, nearest_step
from straightcomp_ros.model.disturbances import (
    FORCE,
    FORCE_RATE,
    OFFSET,
    Disturbances,
    aim,
    disturbing_force,
    interpolated,
)
from straightcomp_ros.model.friction import (
    KIND,
    NO_EXTENSION,
    PLAIN,
    ContactParameters,
    LuGre,
    LuGreParameters,
    bristle_after,
    changes,
    extended_force,
    friction_force,
    lugre_now,
    step_friction,
)
from straightcomp_ros.model.modes import ModesParameters, at_coil, at_encoder, push, swing, turn, yielding
from straightcomp_ros.parameters.declaration import group, parameter

Array = NDArray[np.float64]

SUBSTEP_NS = 25_000
"""Longest substep: 20 in a control cycle at 2 kHz."""
_SHORTEST_SUBSTEP_NS = 100
_RESOLVED = 0.5
"""Largest substep times the rate of the platform on its bristles and flexure; splitting is stable below 2."""
_NEVER = 2**62
"""Later than any time in ns, and small enough for compiled code."""
_FIELDS = 29
"""Numbers of the plant's state."""


def plant_state(y: float = 0.0, velocity: float = 0.0, control: float = 0.0, bias: float = 0.0) -> Array:
    """A state (29,): position m, velocity m/s, bristle deflection m, control and bias current A, friction and magnetic
    force N.

    Only friction beyond plain LuGre, modes and disturbances use the others: time s, age of the contact s where friction
    grows with it, the blocks that slip (bit i of an integer is block i), and the forces of the Maxwell-slip blocks in
    N; two modes, q in m and its rate in m/s (`modes.py`); and what disturbs, in the order of `disturbances.py`.
    """
    state = np.zeros(_FIELDS)
    state[[0, 1, 3, 4]] = y, velocity, control, bias
    return state


class Plant(NamedTuple):
    """Constants of the plant without what friction does beyond LuGre; mass in kg, stop in m, amplifier rate in
    rad/s, stiffness in N/m and damping in N·s/m of the flexure, longest substep in ns."""

    mass: float
    stop: float
    amplifier_rate: float
    actuator: Actuator
    lugre: LuGre
    stiffness: float = 0.0
    damping: float = 0.0
    substep: float = SUBSTEP_NS

    def as_array(self, extension: tuple[float, ...] = NO_EXTENSION) -> Array:
        """The constants, with the ``extension`` of friction, modes and disturbances: an array is passed to compiled
        code 20 times faster than nested tuples."""
        flexure = self.stiffness, self.damping, self.substep
        return np.array([self.mass, self.stop, self.amplifier_rate, *self.actuator, *self.lugre, *flexure, *extension])


def substep_for(mass: float, lugre: LuGre, stiffness: float, damping: float) -> int:
    """Longest substep in ns that resolves how ``mass`` in kg swings on its bristles and a flexure of this stiffness in
    N/m, and how they and its damping in N·s/m slow it down."""
    bristles = lugre.bristle_stiffness if lugre.static > 0.0 else 0.0
    fastest = math.sqrt((bristles + stiffness) / mass)
    fastest = max(fastest, (lugre.bristle_damping + lugre.viscous + damping) / mass)
    return min(SUBSTEP_NS, max(_SHORTEST_SUBSTEP_NS, int(_RESOLVED * 1e9 / max(fastest, 1.0))))


@dataclass(frozen=True)
class PlatformParameters:
    """The platform on the slider."""

    mass: float = parameter(3.0, "Moving mass M of the platform", "[1e-6, 10000] kg")
    stop: float = parameter(1.2e-3, "Mechanical stop at ± this position, inside the air gap", "(0, inf) m")
    stiffness: float = parameter(
        0.0, "Stiffness along y of a flexure that guides the platform, at rest at y = 0; 0: none", "[0, 1e9] N/m"
    )
    damping: float = parameter(0.0, "Damping of that flexure", "[0, 100000] N·s/m")
    modes: ModesParameters = group(ModesParameters)


@dataclass(frozen=True)
class PlantParameters:
    """Platform, magnets, friction, drive and encoders of a machine."""

    platform: PlatformParameters = PlatformParameters()
    actuator: ActuatorParameters = ActuatorParameters()
    friction: LuGreParameters = LuGreParameters()
    contact: ContactParameters = ContactParameters()
    drive: DriveParameters = DriveParameters()
    encoder: EncoderParameters = EncoderParameters()
    disturbances: Disturbances = Disturbances()

    def constants(self) -> Array:
        """The constants of the equations, for :func:`advance`: (75,), and a table of force over x behind them."""
        rate = 2.0 * math.pi * self.drive.bandwidth
        lugre, actuator, platform = self.friction.constants(), self.actuator.constants(), self.platform
        modes, more, flexure = platform.modes, self.disturbances.any, (platform.stiffness, platform.damping)
        # Where the forces act, at the coils, the modes make the platform lighter.
        lightest = platform.mass / (1.0 + sum(mode.coil**2 for mode in modes.present))
        substep = substep_for(lightest, lugre, *flexure)
        plant = Plant(platform.mass, platform.stop, rate, actuator, lugre, *flexure, substep)
        friction = self.contact.extension(self.friction.bristle_stiffness, extended=more or bool(modes.present))
        return plant.as_array((*friction, *modes.constants(), *self.disturbances.constants()))


@compilable
def _from_array(k: Array) -> Plant:
    """The extension is read from the array."""
    lugre = LuGre(k[6], k[7], k[8], k[9], k[10], k[11])
    return Plant(k[0], k[1], k[2], Actuator(k[3], k[4], k[5]), lugre, k[12], k[13], k[14])


@compilable
def _acceleration(plant: Plant, y: float, v: float, z: float, bias: float, control: float) -> float:
    force = magnetic_force(plant.actuator, y, bias, control) - friction_force(plant.lugre, z, v)
    return (force - plant.stiffness * y - plant.damping * v) / plant.mass


@compilable
def _hold(plant: Plant, state: Array, command: float, bias_command: float, duration_ns: int) -> None:
    """Advance ``state`` by ``duration_ns`` > 0 in equal substeps, with constant commanded currents."""
    substeps = -(-duration_ns // int(plant.substep))
    h = duration_ns * 1e-9 / substeps
    settle = 1.0 - math.exp(-h * plant.amplifier_rate)
    y, v, z, control, bias = state[0], state[1], state[2], state[3], state[4]
    for _ in range(substeps):
        v += 0.5 * h * _acceleration(plant, y, v, z, bias, control)
        y += h * v
        z = bristle_after(plant.lugre, z, v, h)
        control += settle * (command - control)
        bias += settle * (bias_command - bias)
        if abs(y) > plant.stop:
            # Inelastic stop: the platform rests against it until the force points away.
            y = math.copysign(plant.stop, y)
            v = 0.0
        v += 0.5 * h * _acceleration(plant, y, v, z, bias, control)
    state[0], state[1], state[2], state[3], state[4] = y, v, z, control, bias


@compilable
def _kick(k: Array, plant: Plant, lugre: LuGre, state: Array, duration: float) -> None:
    """Let all forces act for ``duration`` s on the platform where the coils are."""
    place, speed = at_coil(k, state, 0), at_coil(k, state, 1)
    force = magnetic_force(plant.actuator, place, state[4], state[3] + state[OFFSET])
    force -= extended_force(k, lugre, state, speed)
    force -= plant.stiffness * place + plant.damping * speed
    push(k, state, duration * (force + disturbing_force(k, state)) / plant.mass)


@compilable
def _hold_extended(k: Array, plant: Plant, state: Array, command: float, bias_command: float, duration_ns: int) -> None:
    """As :func:`_hold`, with friction beyond plain LuGre, modes and disturbances."""
    substeps = -(-duration_ns // int(plant.substep))
    h = duration_ns * 1e-9 / substeps
    settle = 1.0 - math.exp(-h * plant.amplifier_rate)
    first, second = turn(k, 0, h), turn(k, 1, h)
    lugre, changing = lugre_now(k, plant.lugre, state, at_coil(k, state, 0)), changes(k)
    for _ in range(substeps):
        _kick(k, plant, lugre, state, 0.5 * h)
        state[0] += h * state[1]
        swing(state, 0, first)
        swing(state, 1, second)
        state[FORCE] += h * state[FORCE_RATE]
        if changing:
            lugre = lugre_now(k, plant.lugre, state, at_coil(k, state, 0))
        step_friction(k, lugre, state, at_coil(k, state, 1), h)
        state[3] += settle * (command - state[3])
        state[4] += settle * (bias_command - state[4])
        place = at_coil(k, state, 0)
        if abs(place) > plant.stop:
            # The coils rest against the stop: a mode may carry them there, too.
            state[0] += math.copysign(plant.stop, place) - place
            push(k, state, -at_coil(k, state, 1) / yielding(k))
        _kick(k, plant, lugre, state, 0.5 * h)


@compiled
def advance(
    constants: Array,
    state: Array,
    bias_command: float,
    command: float,
    duration_ns: int,
    next_command: float = 0.0,
    next_duration_ns: int = 0,
) -> None:
    """Advance ``state`` by ``duration_ns`` with one commanded control current, then by ``next_duration_ns`` with the
    next, so that a control cycle in which a command takes effect is one call.

    ``constants`` are those of :class:`PlantParameters`; ``state``, (29,) in the order of :func:`plant_state`, is
    changed in place. Currents are those commanded of the amplifier in A, durations in ns, zero or more.
    """
    plant = _from_array(constants)
    if constants[KIND] == PLAIN:
        if duration_ns > 0:
            _hold(plant, state, command, bias_command, duration_ns)
        if next_duration_ns > 0:
            _hold(plant, state, next_command, bias_command, next_duration_ns)
        state[5] = friction_force(plant.lugre, state[2], state[1])
        state[6] = magnetic_force(plant.actuator, state[0], state[4], state[3])
    else:
        if duration_ns > 0:
            _hold_extended(constants, plant, state, command, bias_command, duration_ns)
        if next_duration_ns > 0:
            _hold_extended(constants, plant, state, next_command, bias_command, next_duration_ns)
        place = at_coil(constants, state, 0)
        lugre = lugre_now(constants, plant.lugre, state, place)
        state[5] = extended_force(constants, lugre, state, at_coil(constants, state, 1))
        state[6] = magnetic_force(plant.actuator, place, state[4], state[3] + state[OFFSET])


BIAS, COMMAND, _MEAN, _IMPULSE, _ANCHOR, SPEED, PLACE, READING = range(_FIELDS, _FIELDS + 8)
"""Indices in :attr:`CommandedPlant.state`, after the plant's own."""
_NOW, _HOLD_AT, _HOLDING = range(3)
_AFTER_NS, _WEIGHT, _KEPT, _BRAKING, _STIFFNESS, _STEP, _HALF_CODES, _RESOLUTION = range(-8, 0)
"""Indices in :attr:`CommandedPlant.constants`, after the plant's own, from their end."""


class Hold(NamedTuple):
    """How the board holds the platform when commands are late.

    From ``after_ns`` after a command took effect it does; ``weight`` is the share of each command in the mean, ``kept``
    the share of an impulse that friction leaves after a sample, ``braking`` that of it which the board takes back in a
    sample, ``stiffness`` control current per displacement, A/m.
    """

    after_ns: int
    weight: float
    kept: float
    braking: float
    stiffness: float


class CommandedPlant(NamedTuple):
    """Constants and state as :func:`advance_to_sample` takes them.

    Attributes:
        constants: those of the plant; the fields of :class:`Hold`; step of the D/A converter in A, its codes below
            zero, resolution of the encoder in m.
        state: (37,) that of the plant, see :func:`plant_state`; bias current and control current asked of the
            amplifier, mean control current, all in A; impulse beyond that mean in A · samples; position that is held,
            in m; where the encoder of y looks the velocity in m/s and the position in m; its newest reading in m. While
            the bias current asked for is zero, the amplifier is off and commands have no effect.
        times: (3,) int64: the present and the time at which the board begins to hold in ns, and whether it holds.
    """

    constants: Array
    state: Array
    times: NDArray[np.int64]

    def currents_off(self) -> None:
        """Ask the amplifier for no current, and forget the commands that took effect."""
        self.state[BIAS : _IMPULSE + 1] = 0.0
        self.times[_HOLD_AT:] = _NEVER, False

    def set_time(self, time_ns: int) -> None:
        """Go on from this time with the same state."""
        self.times[_NOW] = time_ns


def commanded_plant(plant: PlantParameters, hold: Hold, initial: Array) -> CommandedPlant:
    """The machine at time 0 in the state ``initial``, (29,), with its amplifier off."""
    drive, encoder = plant.drive, plant.encoder
    return CommandedPlant(
        np.array([*plant.constants(), *hold, drive.current_step, drive.half_codes, encoder.y_resolution]),
        np.array([*initial, *[0.0] * 5, initial[1], initial[0], encoder.y_reading(float(initial[0]))]),
        np.array([0, _NEVER, False]),
    )


@compilable
def _count_impulse(constants: Array, state: Array) -> None:
    """The impulse after one more sample with the present current, of which friction leaves a share."""
    state[_IMPULSE] = constants[_KEPT] * (state[_IMPULSE] + (state[COMMAND] - state[_MEAN]))


@compilable
def _converted(constants: Array, current: float) -> float:
    return nearest_step(constants[_STEP], int(constants[_HALF_CODES]), current)


@compilable
def _holding_current(constants: Array, state: Array, displacement: float) -> float:
    """Control current in A while the platform is ``displacement`` (m) away from where it is held."""
    braking = constants[_BRAKING] * state[_IMPULSE]
    return _converted(constants, state[_MEAN] - braking - constants[_STIFFNESS] * displacement)


@compiled
def advance_to_sample(
    constants: Array,
    state: Array,
    times: NDArray[np.int64],
    effective: NDArray[np.int64],
    asked: Array,
    count: int,
    until: int,
    noise: float,
    x: float,
) -> int:
    """Integrate up to ``until`` (ns), which is not in the past, and read the encoder of y there, whose ``noise`` in m
    is added before it rounds. The stage is at ``x`` (m) then. Returns how many of the waiting commands took effect.

    ``state`` and ``times`` of the :class:`CommandedPlant` are changed in place. ``count`` commands wait: they take
    effect at the times ``effective`` (ns, rising), and ask for the control current ``asked`` (A, before the D/A
    converter).
    """
    taken = 0
    extended = constants[KIND] != PLAIN
    if extended:
        aim(constants, state, constants[0], x, (until - times[_NOW]) * 1e-9)
    while True:
        # Each call of advance() spans one command, up to what comes next.
        if taken < count and effective[taken] <= until and effective[taken] <= times[_HOLD_AT]:
            at = effective[taken]
            taken += 1
            if state[BIAS] <= 0.0:
                # Not even on the steps of the integration.
                continue
            current = _converted(constants, asked[taken - 1])
            state[_MEAN] += constants[_WEIGHT] * (current - state[_MEAN])
            times[_HOLD_AT], times[_HOLDING] = at + int(constants[_AFTER_NS]), False
        elif times[_HOLD_AT] <= until:
            # The last command fought the error of its own moment; held for longer it drives the platform away.
            at = times[_HOLD_AT]
            times[_HOLD_AT], times[_HOLDING], state[_ANCHOR] = _NEVER, True, state[READING]
            _count_impulse(constants, state)
            current = _holding_current(constants, state, 0.0)
        else:
            break
        end = min(until, times[_HOLD_AT])
        if taken < count:
            end = min(end, effective[taken])
        advance(constants, state, state[BIAS], state[COMMAND], at - times[_NOW], current, end - at)
        state[COMMAND], times[_NOW] = current, end
    if times[_NOW] < until:
        rest = until - times[_NOW]
        # A literal 0 would be a type of its own to numba, for which it compiles advance() once more.
        advance(constants, state, state[BIAS], state[COMMAND], rest, 0.0, rest - rest)
        times[_NOW] = until
    state[SPEED], state[PLACE] = state[1], state[0]
    seen = state[0]
    if extended:
        state[SPEED], state[PLACE] = at_encoder(constants, state, 1), at_encoder(constants, state, 0)
        seen = interpolated(constants, state[PLACE])
    state[READING] = nearest_count(constants[_RESOLUTION], seen + noise)
    _count_impulse(constants, state)
    if times[_HOLDING]:
        state[COMMAND] = _holding_current(constants, state, state[READING] - state[_ANCHOR])
    return taken
