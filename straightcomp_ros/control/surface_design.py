"""Design of the sliding surface (8), and the continuous closed loop that it gives.

State x = [−∫e, y, ẏ]ᵀ (6), sliding variable σ = S x with S = [ωn², 2ζωn, 1] (8). On the nominal plant (9) without its
switching term places the poles at the roots of s² + 2ζωn s + ωn² and at −φ.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.model.actuator import stiffness_errors
from straightcomp_ros.parameters.declaration import parameter
from straightcomp_ros.stage.description import StageParameters


@dataclass(frozen=True)
class SlidingDesign:
    """Sliding surface and reaching law of (8) and (9), for 'smc', and without switching for 'linear'."""

    zeta: float = parameter(0.8, "Damping ratio ζ on the sliding surface", "(0, 10]")
    natural_frequency: float = parameter(35.0, "Natural frequency ωn/2π on the sliding surface", "(0, 10000] Hz")
    phi: float = parameter(100.0, "Rate φ at which the sliding variable σ decays", "(0, 100000] 1/s")
    rho: float = parameter(1.0, "Switching gain ρ, of smc alone", "(0, 10000] m/s²")
    gamma: float = parameter(0.1, "Margin γ of the reaching condition (11)", "[0, 10000] m/s²")
    enforce_reaching: bool = parameter(True, "Refuse a rho that does not fulfil the reaching condition (11)")
    boundary_layer: float = parameter(
        4e-3, "Half width of the boundary layer around σ = 0, of smc alone; 0 switches with sgn σ", "[0, 10] m/s"
    )
    velocity_bandwidth: float = parameter(
        1000.0, "Bandwidth of the estimate of the platform's velocity", "(0, 100000] Hz"
    )
    feedforward: bool = parameter(
        True, "Let smc follow the reference's rates; false: the paper's (9), which lags by 2ζ/ωn"
    )

    @property
    def omega_n(self) -> float:
        """ωn in rad/s."""
        return 2.0 * math.pi * self.natural_frequency


def state_matrices(stage: StageParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A (3, 3) and B (3,) of (6), with the control current in A as the input instead of u (so K_a = 1)."""
    actuator, mass = stage.actuator, stage.platform.mass
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, actuator.position_stiffness / mass, 0.0]])
    return a, np.array([0.0, 0.0, actuator.current_stiffness / mass])


def feedback_gains(design: SlidingDesign, stage: StageParameters) -> NDArray[np.float64]:
    """K (3,) with i_c = −K x: (9) without its switching term and with r = 0, i.e. (SB)⁻¹ (SA + φS)."""
    a, b = state_matrices(stage)
    s = np.array([design.omega_n**2, 2.0 * design.zeta * design.omega_n, 1.0])
    return np.asarray((s @ a + design.phi * s) / (s @ b))


def closed_loop_poles(design: SlidingDesign, stage: StageParameters) -> NDArray[np.inexact[Any]]:
    """Poles (3,) in rad/s of the nominal plant under (9) without its switching term: the eigenvalues of A − B K."""
    a, b = state_matrices(stage)
    return np.linalg.eigvals(a - np.outer(b, feedback_gains(design, stage)))


def reaching_bound(design: SlidingDesign, stage: StageParameters) -> float:
    """Smallest ρ in m/s² that fulfils (11) within the travel, at rest on the reference.

    There SAx + SB_r r = (K̄_y/M) y (x₁ = 0, ẏ = 0, y = r), the matched disturbance is friction over mass and the
    stiffness error m_y, and |m_i| is largest at full travel with the current that holds position and friction.
    """
    actuator, mass = stage.actuator, stage.platform.mass
    travel, friction = stage.guide.travel, stage.friction.static
    a = travel / actuator.air_gap
    hold = (actuator.position_stiffness * travel + friction) / actuator.current_stiffness
    m_y, m_i = stiffness_errors(a, min(1.0, hold / actuator.bias_current))
    if abs(m_i) >= 1.0:
        return math.inf
    position = actuator.position_stiffness / mass * travel
    disturbance = m_y * position + friction / mass
    return (abs(m_i) * position + disturbance + design.gamma) / (1.0 - abs(m_i))
