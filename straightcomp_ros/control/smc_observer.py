"""Law `smc_observer`: sliding mode on the tracking error, with observer, feedforward and exact inverse.

The sliding variable σ = (ẏ − ṙ) + λ (y − r) is that of the moment at which the command acts, from an extended state
observer that knows the loop's delay (`observer.py`). The reaching law is the implicit Euler discretisation of
σ̇ = −ρ sgn σ over a horizon 1/κ (Acary and Brogliato, Systems & Control Letters 59, 2010):

    σ⁺ = σ − ρ sgn(σ⁺)/κ  ⇒  a_s = −proj_[−ρ, ρ](κ σ),

which reaches σ = 0 without overshoot and without the chattering of the explicit sgn. The observer's disturbance
estimate (friction, model errors) is subtracted, so that ρ must exceed only its error. The map's ṙ and r̈ are fed
forward, so that a moving reference leaves no lag.

Tuning: first ``gain_allowance``, the assumed acceleration per current relative to nominal. More of it lowers the loop's
gain: machines with strong magnets, little mass or late commands stay stable; too much, and a weak machine does not hold
against the negative stiffness (`margins.py` gives both limits). Then the observer's bandwidth, as high as encoder noise
and the jitter of the delay allow; then λ and κ, until the spread over uncertain machines (`straightcomp robustness`)
grows.
"""

from typing import NamedTuple

from straightcomp_ros.control.law import Command
from straightcomp_ros.control.observer import Estimate, Loop, current_for, limited, moment_of_action, next_prior
from straightcomp_ros.model.compiled import compilable


class Gains(NamedTuple):
    """λ in 1/s, κ in 1/s, ρ in m/s², and the loop."""

    surface: float
    reaching: float
    rho: float
    loop: Loop


class State(NamedTuple):
    """The next sample as predicted, and the commanded current in A."""

    prior: Estimate
    command: float


def start(y: float) -> State:
    """State at rest at ``y`` in m."""
    return State(Estimate(y, 0.0, 0.0, 0.0), 0.0)


@compilable
def step(
    g: Gains, state: State, y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> tuple[State, Command]:
    """One sample; see the module."""
    at = moment_of_action(g.loop, state.prior, state.command, y, r, r_dot, r_ddot, current)
    sigma = at.rate_error + g.surface * at.position_error
    reaching = -max(-g.rho, min(g.rho, g.reaching * sigma))
    holding = r_ddot - g.surface * at.rate_error - at.action.disturbance
    equivalent = current_for(g.loop, at.action.y, holding)
    asked = current_for(g.loop, at.action.y, holding + reaching)
    answer = limited(g.loop, asked)
    command = Command(answer, r - y, sigma, equivalent, asked - equivalent, at.now.velocity, at.now.disturbance)
    return State(next_prior(g.loop, at.action, answer), answer), command
