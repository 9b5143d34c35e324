"""Laws `linear` and `smc`: the paper's (9), sampled, without and with its switching term."""

import math
from typing import NamedTuple

from straightcomp_ros.control.law import Command
from straightcomp_ros.control.surface_design import SlidingDesign, feedback_gains, state_matrices
from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.stage.description import StageParameters


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


class State(NamedTuple):
    """∫(y − r) in m·s, last reading in m, velocity estimate in m/s."""

    integral: float
    y: float
    velocity: float


def gains(
    design: SlidingDesign,
    stage: StageParameters,
    *,
    switching: bool,
    feedforward: bool,
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
        current_limit=stage.actuator.current_limit,
    )


@compilable
def switching_function(sigma: float, boundary_layer: float) -> float:
    """sgn σ, or σ/ε inside a boundary layer of half width ε (Slotine and Sastry, 1983)."""
    if abs(sigma) < boundary_layer:
        return sigma / boundary_layer
    return math.copysign(1.0, sigma) if sigma != 0.0 else 0.0


def start(y: float) -> State:
    """State at rest at ``y`` in m."""
    return State(0.0, y, 0.0)


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
    asked = equivalent + switching
    command = max(-g.current_limit, min(g.current_limit, asked))
    # More ∫(y − r) means less current.
    if command == asked or (y - r) * asked > 0.0:
        integral += g.period * (y - r)
    return State(integral, y, velocity), Command(command, r - y, sigma, equivalent, switching, velocity, math.nan)
