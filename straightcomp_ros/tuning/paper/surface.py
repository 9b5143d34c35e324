"""Closed forms of the sliding motion: how long the surface takes to be reached, and (12) on it."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from straightcomp_ros.control.sliding_mode import SlidingDesign
from straightcomp_ros.model.actuator import stiffness_errors
from straightcomp_ros.stage.description import StageParameters


def sliding_variable_at_rest(design: SlidingDesign, y: float) -> float:
    """σ in m/s by (8) at rest at ``y`` in m with nothing integrated: 2ζωn y."""
    return 2.0 * design.zeta * design.omega_n * y


def reaching_time(phi: float, rho: float, sigma_0: float) -> float:
    """Time in s until σ = 0 from σ0 in m/s, where σ̇ = −φσ − ρ sgn σ: (1/φ) ln(1 + φ|σ0|/ρ).

    φ = 0 gives its limit |σ0|/ρ. The law (9) gives this σ̇ on the nominal plant.
    """
    if phi == 0.0:
        return abs(sigma_0) / rho
    return math.log1p(phi * abs(sigma_0) / rho) / phi


def sliding_variable_over(time: NDArray[np.float64], phi: float, rho: float, sigma_0: float) -> NDArray[np.float64]:
    """σ(t) in m/s on the nominal plant, for σ0 > 0: decays until the reaching time, zero from then on."""
    level = rho / phi
    return np.maximum((sigma_0 + level) * np.exp(-phi * time) - level, 0.0)


def rate_implied(time: float, rho: float, sigma_0: float) -> float:
    """φ in 1/s for which the surface is reached after ``time`` in s; NaN if none reaches it as late.

    The larger φ, the sooner; the latest is |σ0|/ρ, at φ = 0.
    """
    if reaching_time(0.0, rho, sigma_0) < time:
        return math.nan
    return float(brentq(lambda phi: reaching_time(phi, rho, sigma_0) - time, 0.0, 1e4))


def gain_implied(time: float, phi: float, sigma_0: float) -> float:
    """ρ in m/s² for which the surface is reached after ``time`` in s at the rate ``phi``."""
    return phi * abs(sigma_0) / math.expm1(phi * time)


def reaching_demand(design: SlidingDesign, stage: StageParameters, y: float, current: float) -> float:
    """ρ in m/s² that (11) demands at rest at ``y`` with r = 0 and nothing integrated, for the current i_c in A.

    There SAx + SB_r r = (ωn² + K̄_y/M) y, and SBη is the stiffness error and friction over mass. Infinite
    where |m_i| >= 1.
    """
    actuator, mass = stage.actuator, stage.platform.mass
    m_y, m_i = stiffness_errors(y / actuator.air_gap, current / actuator.bias_current)
    if abs(m_i) >= 1.0:
        return math.inf
    stiffness = actuator.position_stiffness / mass
    motion = (design.omega_n**2 + stiffness) * abs(y)
    disturbance = m_y * stiffness * abs(y) + stage.friction.static / mass
    return (abs(m_i) * motion + disturbance + design.gamma) / (1.0 - abs(m_i))


def free_motion(time: NDArray[np.float64], design: SlidingDesign, y_0: float, velocity_0: float) -> NDArray[np.float64]:
    """y(t) in m by (12) with r = 0, ζ < 1, from ``y_0`` in m and ``velocity_0`` in m/s at time zero."""
    decay = design.zeta * design.omega_n
    damped = design.omega_n * math.sqrt(1.0 - design.zeta**2)
    sine = (velocity_0 + decay * y_0) / damped
    return np.exp(-decay * time) * (y_0 * np.cos(damped * time) + sine * np.sin(damped * time))


def following_error_gain(design: SlidingDesign, omega: float) -> float:
    """|e/r| by (12) for a reference of ``omega`` in rad/s: |s² + 2ζωn s| / |s² + 2ζωn s + ωn²| at s = jω.

    For slow references this is ω · 2ζ/ωn: the reference is followed with a lag of 2ζ/ωn.
    """
    s = 1j * omega
    moving = s * s + 2.0 * design.zeta * design.omega_n * s
    return abs(moving / (moving + design.omega_n**2))


def lag(design: SlidingDesign) -> float:
    """2ζ/ωn in s: by so much the law follows a slow reference late, by (12)."""
    return 2.0 * design.zeta / design.omega_n
