"""Law `super_twisting`: Levant's second-order sliding mode on the tracking error, for comparison.

    a = r̈ − λ (ẏ − ṙ) − k₁ |σ|^½ sgn σ + w,   ẇ = −k₂ sgn σ,   k₁ = 1.5 √L,  k₂ = 1.1 L

(Levant, Int. J. Control 58(6), 1993; the gains after Shtessel, Edwards, Fridman, Levant, Sliding Mode Control and
Observation, 2014, ch. 4). L bounds the disturbance's rate |ḋ| in m/s³. σ = (ẏ − ṙ) + λ (y − r) comes from the same
delay-aware observer as in `smc_observer`; its disturbance estimate serves the prediction only, because w replaces it.

Tuning: L as small as the reversals of friction allow; with a larger L, √|σ| amplifies the encoder's noise.
"""

import math
from typing import NamedTuple

from straightcomp_ros.control.law import Command
from straightcomp_ros.control.observer import Estimate, Loop, current_for, limited, moment_of_action, next_prior
from straightcomp_ros.model.compiled import compilable


class Gains(NamedTuple):
    """λ in 1/s, k₁ in m^½/s^(3/2), k₂ in m/s³, and the loop."""

    surface: float
    k1: float
    k2: float
    loop: Loop


class State(NamedTuple):
    """The next sample as predicted, the commanded current in A, and w in m/s²."""

    prior: Estimate
    command: float
    integral: float


def gains(surface: float, disturbance_rate: float, loop: Loop) -> Gains:
    """Gains for λ in 1/s and L in m/s³."""
    return Gains(surface, 1.5 * math.sqrt(disturbance_rate), 1.1 * disturbance_rate, loop)


def start(y: float) -> State:
    """State at rest at ``y`` in m."""
    return State(Estimate(y, 0.0, 0.0, 0.0), 0.0, 0.0)


@compilable
def step(
    g: Gains, state: State, y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> tuple[State, Command]:
    """One sample; see the module. The integral is held while the current is at its limit."""
    at = moment_of_action(g.loop, state.prior, state.command, y, r, r_dot, r_ddot, current)
    sigma = at.rate_error + g.surface * at.position_error
    sign = math.copysign(1.0, sigma) if sigma != 0.0 else 0.0
    twisting = -g.k1 * math.sqrt(abs(sigma)) * sign + state.integral
    holding = r_ddot - g.surface * at.rate_error
    equivalent = current_for(g.loop, at.action.y, holding)
    asked = current_for(g.loop, at.action.y, holding + twisting)
    answer = limited(g.loop, asked)
    integral = state.integral
    if answer == asked:
        integral -= g.loop.period * g.k2 * sign
    command = Command(answer, r - y, sigma, equivalent, asked - equivalent, at.now.velocity, at.now.disturbance)
    return State(next_prior(g.loop, at.action, answer), answer, integral), command
