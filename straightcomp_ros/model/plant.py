"""The platform in Y: M ÿ = f_c − F_friction (1), between mechanical stops, behind the power amplifier.

Fixed substeps by Strang splitting (half a kick, drift, exact bristle step, half a kick): second order, symplectic
without friction, and never stiff, because the bristle's step is exact. The inertial force of the guide's deviation,
M δ̈, stays below 5 mN (a fifth of a D/A step) and is left out, as in (1).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.actuator import Actuator, ActuatorParameters, magnetic_force
from straightcomp_ros.model.compiled import compilable, compiled
from straightcomp_ros.model.converters import DriveParameters, EncoderParameters
from straightcomp_ros.model.extended_friction import KIND, PLAIN, extended_force, lugre_now, step_friction
from straightcomp_ros.model.lugre import (
    NO_EXTENSION,
    ContactParameters,
    LuGre,
    LuGreParameters,
    bristle_after,
    friction_force,
)
from straightcomp_ros.parameters.declaration import parameter

SUBSTEP_NS = 25_000
"""Longest substep: 20 in a control cycle at 2 kHz."""


class PlantState(NamedTuple):
    """Position m, velocity m/s, bristle deflection m, control and bias current A, and the two forces in N.

    Only friction beyond plain LuGre uses the others: time s, age of the contact s, the blocks that slip (bit i of an
    integer is block i), and the forces of the Maxwell-slip blocks in N.
    """

    y: float = 0.0
    velocity: float = 0.0
    bristle: float = 0.0
    control: float = 0.0
    bias: float = 0.0
    friction_force: float = 0.0
    magnetic_force: float = 0.0
    time: float = 0.0
    age: float = 0.0
    slipping: float = 0.0
    block_0: float = 0.0
    block_1: float = 0.0
    block_2: float = 0.0
    block_3: float = 0.0
    block_4: float = 0.0
    block_5: float = 0.0
    block_6: float = 0.0
    block_7: float = 0.0


class _Plant(NamedTuple):
    """The constants that every compiled step needs."""

    mass: float
    stop: float
    amplifier_rate: float
    actuator: Actuator
    lugre: LuGre


class Plant(NamedTuple):
    """Constants of the plant; mass in kg, stop in m, amplifier rate in rad/s.

    ``extension`` is that of the friction, see :meth:`~straightcomp_ros.model.lugre.ContactParameters.extension`.
    """

    mass: float
    stop: float
    amplifier_rate: float
    actuator: Actuator
    lugre: LuGre
    extension: tuple[float, ...] = NO_EXTENSION


@dataclass(frozen=True)
class PlatformParameters:
    """The platform on the slider."""

    mass: float = parameter(3.0, "Moving mass M of the platform", "(0, 10000] kg")
    stop: float = parameter(1.2e-3, "Mechanical stop at ± this position, inside the air gap", "(0, inf) m")


@dataclass(frozen=True)
class PlantParameters:
    """Platform, magnets, friction, drive and encoders of a machine."""

    platform: PlatformParameters = PlatformParameters()
    actuator: ActuatorParameters = ActuatorParameters()
    friction: LuGreParameters = LuGreParameters()
    contact: ContactParameters = ContactParameters()
    drive: DriveParameters = DriveParameters()
    encoder: EncoderParameters = EncoderParameters()

    def constants(self) -> Plant:
        """The constants of the equations; :func:`advance` takes them :func:`as_array`."""
        rate = 2.0 * math.pi * self.drive.bandwidth
        lugre = self.friction.constants()
        extension = self.contact.extension(self.friction.bristle_stiffness)
        return Plant(self.platform.mass, self.platform.stop, rate, self.actuator.constants(), lugre, extension)


def as_array(plant: Plant) -> NDArray[np.float64]:
    """The constants, (40,) float64: an array is passed to compiled code 20 times faster than nested tuples."""
    return np.array([plant.mass, plant.stop, plant.amplifier_rate, *plant.actuator, *plant.lugre, *plant.extension])


@compilable
def _from_array(k: NDArray[np.float64]) -> _Plant:
    return _Plant(k[0], k[1], k[2], Actuator(k[3], k[4], k[5]), LuGre(k[6], k[7], k[8], k[9], k[10], k[11]))


@compilable
def _acceleration(plant: _Plant, y: float, v: float, z: float, bias: float, control: float) -> float:
    return (magnetic_force(plant.actuator, y, bias, control) - friction_force(plant.lugre, z, v)) / plant.mass


@compilable
def _hold(plant: _Plant, state: NDArray[np.float64], command: float, bias_command: float, duration_ns: int) -> None:
    """Advance ``state`` by ``duration_ns`` > 0 in equal substeps, with constant commanded currents."""
    substeps = -(-duration_ns // SUBSTEP_NS)
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
def _hold_extended(
    k: NDArray[np.float64],
    plant: _Plant,
    state: NDArray[np.float64],
    command: float,
    bias_command: float,
    duration_ns: int,
) -> None:
    """As :func:`_hold`, with friction beyond plain LuGre."""
    substeps = -(-duration_ns // SUBSTEP_NS)
    h = duration_ns * 1e-9 / substeps
    settle = 1.0 - math.exp(-h * plant.amplifier_rate)
    y, v, control, bias = state[0], state[1], state[3], state[4]
    lugre = lugre_now(k, plant.lugre, state, y)
    for _ in range(substeps):
        force = magnetic_force(plant.actuator, y, bias, control) - extended_force(k, lugre, state, v)
        v += 0.5 * h * force / plant.mass
        y += h * v
        lugre = lugre_now(k, plant.lugre, state, y)
        step_friction(k, lugre, state, v, h)
        control += settle * (command - control)
        bias += settle * (bias_command - bias)
        if abs(y) > plant.stop:
            y = math.copysign(plant.stop, y)
            v = 0.0
        force = magnetic_force(plant.actuator, y, bias, control) - extended_force(k, lugre, state, v)
        v += 0.5 * h * force / plant.mass
    state[0], state[1], state[3], state[4] = y, v, control, bias


@compiled
def advance(
    constants: NDArray[np.float64],
    state: NDArray[np.float64],
    bias_command: float,
    command: float,
    duration_ns: int,
    next_command: float = 0.0,
    next_duration_ns: int = 0,
) -> None:
    """Advance ``state`` by ``duration_ns`` with one commanded control current, then by ``next_duration_ns`` with the
    next, so that a control cycle in which a command takes effect is one call.

    Args:
        constants: :func:`as_array` of the plant.
        state: (18,) float64 in the order of :class:`PlantState`; changed in place.
        bias_command, command, next_command: currents commanded of the amplifier, A.
        duration_ns, next_duration_ns: ns, zero or more.
    """
    plant = _from_array(constants)
    if constants[KIND] == PLAIN:
        if duration_ns > 0:
            _hold(plant, state, command, bias_command, duration_ns)
        if next_duration_ns > 0:
            _hold(plant, state, next_command, bias_command, next_duration_ns)
        state[5] = friction_force(plant.lugre, state[2], state[1])
    else:
        if duration_ns > 0:
            _hold_extended(constants, plant, state, command, bias_command, duration_ns)
        if next_duration_ns > 0:
            _hold_extended(constants, plant, state, next_command, bias_command, next_duration_ns)
        state[5] = extended_force(constants, lugre_now(constants, plant.lugre, state, state[0]), state, state[1])
    state[6] = magnetic_force(plant.actuator, state[0], state[4], state[3])
