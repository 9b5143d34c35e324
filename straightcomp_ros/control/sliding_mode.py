"""Laws `linear` and `smc`: the sliding surface (8), and the paper's (9), sampled, without and with its switching term.

State x = [−∫e, y, ẏ]ᵀ (6), sliding variable σ = S x with S = [ωn², 2ζωn, 1] (8). On the nominal plant (9) without its
switching term places the poles at the roots of s² + 2ζωn s + ωn² and at −φ.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.filters import EMPTY, NONE, Filters, Memory, filtered
from straightcomp_ros.control.law import Command
from straightcomp_ros.control.observer import limited
from straightcomp_ros.model.actuator import stiffness_errors
from straightcomp_ros.model.compiled import compilable
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
    mass, damping = stage.platform.mass, stage.platform.damping
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, stage.negative_stiffness / mass, -damping / mass]])
    return a, np.array([0.0, 0.0, stage.actuator.current_stiffness / mass])


def feedback_gains(design: SlidingDesign, stage: StageParameters) -> NDArray[np.float64]:
    """K (3,) with i_c = −K x: (9) without its switching term and with r = 0, i.e. (SB)⁻¹ (SA + φS)."""
    a, b = state_matrices(stage)
    s = np.array([design.omega_n**2, 2.0 * design.zeta * design.omega_n, 1.0])
    return np.asarray((s @ a + design.phi * s) / (s @ b))


def closed_loop_poles(design: SlidingDesign, stage: StageParameters) -> NDArray[np.inexact[Any]]:
    """Poles (3,) in rad/s of the nominal plant under (9) without its switching term: the eigenvalues of A − B K."""
    a, b = state_matrices(stage)
    return np.linalg.eigvals(a - np.outer(b, feedback_gains(design, stage)))


def reaching_demand(design: SlidingDesign, stage: StageParameters, y: float, current: float) -> float:
    """ρ in m/s² that (11) demands at rest on the reference at ``y`` >= 0 in m, for the current i_c in A, with nothing
    integrated.

    There SAx + SB_r r = ((K̄_y − k)/M) y (x₁ = 0, ẏ = 0, y = r), with a flexure's stiffness k. The matched disturbance
    is friction over mass and the stiffness error m_y of the magnets. Infinite where |m_i| >= 1.
    """
    actuator, mass = stage.actuator, stage.platform.mass
    m_y, m_i = stiffness_errors(y / actuator.air_gap, current / actuator.bias_current)
    if abs(m_i) >= 1.0:
        return math.inf
    motion = stage.negative_stiffness / mass * y
    disturbance = m_y * (actuator.position_stiffness / mass * y) + stage.friction.static / mass
    return (abs(m_i) * abs(motion) + disturbance + design.gamma) / (1.0 - abs(m_i))


def reaching_bound(design: SlidingDesign, stage: StageParameters) -> float:
    """Smallest ρ in m/s² that fulfils (11) within the travel, at rest on the reference: |m_i| is largest at full travel
    with the current that holds position and friction, taken with the sign of y: with the other |m_i| is smaller."""
    actuator, travel = stage.actuator, stage.guide.travel
    hold = (abs(stage.negative_stiffness) * travel + stage.friction.static) / actuator.current_stiffness
    return reaching_demand(design, stage, travel, min(actuator.bias_current, hold))


class Gains(NamedTuple):
    """Numbers of (9), sampled, with the current as the input."""

    period: float
    smoothing: float
    surface_integral: float
    surface_position: float
    k_integral: float
    k_position: float
    k_velocity: float
    k_reference: float
    k_reference_rate: float
    k_reference_acceleration: float
    feedforward: float
    k_switching: float
    boundary_layer: float
    current_limit: float
    filters: Filters


class State(NamedTuple):
    """∫(y − r) in m·s, last reading in m, velocity estimate in m/s, and the filters."""

    integral: float
    y: float
    velocity: float
    memory: Memory = EMPTY


def gains(
    design: SlidingDesign, stage: StageParameters, filters: Filters = NONE, *, switching: bool, feedforward: bool
) -> Gains:
    """Numbers of (9) on a stage.

    As printed, (9) takes S x and the reference's part −(SB)⁻¹ SB_r r = ωn² r M / K̄_i, and follows a moving r with a lag
    of 2ζ/ωn. With ``feedforward`` the surface is that of the error,

        σ = ωn² ∫(y − r) + 2ζωn (y − r) + (ẏ − ṙ),

    and σ̇ = −φσ − ρ sgn σ on the nominal plant asks for the reference's part
    ωn² r + 2ζωn ṙ + r̈ + φ (2ζωn r + ṙ), times M / K̄_i: on σ = 0 the error itself decays with ζ and ωn, without lag.
    """
    k_integral, k_position, k_velocity = feedback_gains(design, stage).tolist()
    input_gain = float(state_matrices(stage)[1][2])
    surface_position = 2.0 * design.zeta * design.omega_n
    follow = 1.0 if feedforward else 0.0
    return Gains(
        period=stage.period,
        smoothing=1.0 - math.exp(-2.0 * math.pi * design.velocity_bandwidth * stage.period),
        surface_integral=design.omega_n**2,
        surface_position=surface_position,
        k_integral=k_integral,
        k_position=k_position,
        k_velocity=k_velocity,
        k_reference=(design.omega_n**2 + follow * design.phi * surface_position) / input_gain,
        k_reference_rate=follow * (surface_position + design.phi) / input_gain,
        k_reference_acceleration=follow / input_gain,
        feedforward=follow,
        k_switching=design.rho / input_gain if switching else 0.0,
        boundary_layer=design.boundary_layer,
        current_limit=stage.highest_current,
        filters=filters,
    )


@compilable
def switching_function(sigma: float, boundary_layer: float) -> float:
    """sgn σ, or σ/ε inside a boundary layer of half width ε (Slotine and Sastry, 1983)."""
    if abs(sigma) < boundary_layer:
        return sigma / boundary_layer
    return math.copysign(1.0, sigma) if sigma != 0.0 else 0.0


def start(y: float) -> State:
    """State at rest at ``y`` in m."""
    return State(0.0, y, 0.0, EMPTY)


@compilable
def step(
    g: Gains, state: State, y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> tuple[State, Command]:
    """One sample of (9) on x = [−∫e, y, ẏ]: linear control where the switching gain is zero.

    ẏ is the difference of two readings over the period, smoothed by a first-order filter. While the current is at its
    limit, the integral is held if it would push further (anti-windup). The measured current is not used.
    """
    velocity = state.velocity + g.smoothing * ((y - state.y) / g.period - state.velocity)
    integral = state.integral
    sigma = g.surface_integral * integral + g.surface_position * (y - g.feedforward * r)
    sigma += velocity - g.feedforward * r_dot
    following = g.k_reference * r + g.k_reference_rate * r_dot + g.k_reference_acceleration * r_ddot
    equivalent = following - (g.k_integral * integral + g.k_position * y + g.k_velocity * velocity)
    switching = -g.k_switching * switching_function(sigma, g.boundary_layer)
    wanted = equivalent + switching
    asked, memory = filtered(g.filters, state.memory, wanted, y - r)
    equivalent += asked - wanted
    command = limited(g.current_limit, asked)
    # More ∫(y − r) means less current.
    if command == asked or (y - r) * asked > 0.0:
        integral += g.period * (y - r)
    answer = Command(command, r - y, sigma, equivalent, switching, velocity, math.nan)
    return State(integral, y, velocity, memory), answer
