"""The pair of opposed electromagnets: equations (2) to (4), and the exact inverse of (2) in the current."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.parameters.declaration import parameter

MU_0 = 4e-7 * math.pi
"""Vacuum permeability, H/m."""
UNIT_GAIN_ERROR_LIMIT = (math.sqrt(3.0) - 1.0) / 2.0
"""Largest |y/y0| with |m_i| <= 1 over all |i_c/I0| <= 1: the root of 2a⁴ − 5a² − a + 1 = 0."""


class Actuator(NamedTuple):
    """Constants of (2): μ0 N² A / 4 in N·m²/A², air gap y0 in m, bias current I0 in A."""

    force_coefficient: float
    air_gap: float
    bias_current: float


@dataclass(frozen=True)
class ActuatorParameters:
    """Opposed electromagnets with a common bias current."""

    turns: float = parameter(400.0, "Turns N of each coil", "[1, 100000]")
    pole_area: float = parameter(5e-4, "Pole area A of each magnet", "[1e-9, 1] m²")
    air_gap: float = parameter(1.5e-3, "Air gap y0, platform in the middle", "[1e-6, 0.1] m")
    bias_current: float = parameter(1.0, "Bias current I0 of both coils", "[0.001, 100] A")
    current_limit: float = parameter(
        0.9,
        "Largest control current |i_c|; a command beyond it is a fault that switches the amplifier off",
        "(0, 100] A",
    )

    @property
    def current_stiffness(self) -> float:
        """K̄_i = μ0 N² A I0 / y0² in N/A, from (3)."""
        return MU_0 * self.turns**2 * self.pole_area * self.bias_current / self.air_gap**2

    @property
    def position_stiffness(self) -> float:
        """K̄_y = μ0 N² A I0² / y0³ in N/m, from (3): the negative stiffness of the magnets."""
        return self.current_stiffness * self.bias_current / self.air_gap

    def constants(self) -> Actuator:
        """The constants of the force functions."""
        return Actuator(MU_0 * self.turns**2 * self.pole_area / 4.0, self.air_gap, self.bias_current)


@compilable
def magnetic_force(actuator: Actuator, y: float, bias: float, control: float) -> float:
    """Force on the platform in N by (2), for the actual currents in A: ``bias`` in both coils, and ``control``, i_c.

    |y| < y0 in m is positive toward the magnet that carries bias + control.
    """
    near = (bias + control) / (actuator.air_gap - y)
    far = (bias - control) / (actuator.air_gap + y)
    return actuator.force_coefficient * (near * near - far * far)


@compilable
def stiffness_errors(a: float, b: float) -> tuple[float, float]:
    """Relative errors (m_y, m_i) of the constant stiffnesses by (4), at a = y/y0 and b = i_c/I0."""
    a2 = a * a
    square = (1.0 - a2) * (1.0 - a2)
    return 1.0 / square - 1.0, (3.0 * a2 - a2 * a2 + a * b) / square


@compilable
def control_current(actuator: Actuator, y: float, force: float) -> float:
    """Control current in A for which (2) gives ``force`` in N at ``y``, with the bias current I0 on.

    Solves a b² + (1 + a²) b + a − f (1 − a²)² / (K̄_i I0) = 0 for the root that tends to f / (K̄_i I0) − a at small a,
    in a form without cancellation there. Beyond the largest force of the magnets: the vertex of (2), the nearest.
    """
    a = y / actuator.air_gap
    a2 = a * a
    # K̄_i I0 = μ0 N² A I0² / y0²
    scale = 4.0 * actuator.force_coefficient * actuator.bias_current * actuator.bias_current
    scale /= actuator.air_gap * actuator.air_gap
    constant = a - force * (1.0 - a2) * (1.0 - a2) / scale
    linear = 1.0 + a2
    discriminant = linear * linear - 4.0 * a * constant
    if discriminant < 0.0:
        return actuator.bias_current * -linear / (2.0 * a)
    return actuator.bias_current * (-2.0 * constant / (linear + math.sqrt(discriminant)))
