"""What the observer-based laws share: the error at the moment the command will act, and the current for a force.

A command computed from the sample of time t acts from t + delay on. The law therefore judges the state that the
observer predicts for that moment against the reference of that moment, and answers with an acceleration; the exact
inverse of (2) makes the current of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from straightcomp_ros.control.observer import Estimate, ObserverGains, corrected, observer_gains, predicted
from straightcomp_ros.model.actuator import Actuator, ActuatorParameters, control_current
from straightcomp_ros.model.compiled import compilable

_USABLE_GAP = 0.95
"""Fraction of the air gap within which the inverse is asked for: it is singular at the poles."""


class Loop(NamedTuple):
    """The loop as a law believes it: s, s, rad/s, kg, A, then observer and magnets."""

    period: float
    delay: float
    amplifier_rate: float
    mass: float
    current_limit: float
    observer: ObserverGains
    actuator: Actuator


class Moment(NamedTuple):
    """Estimate for the sample, estimate for the moment of action, and the errors y − r and ẏ − ṙ there."""

    now: Estimate
    action: Estimate
    position_error: float
    rate_error: float


def loop(
    *,
    period: float,
    delay_samples: float,
    amplifier_bandwidth: float,
    observer_bandwidth: float,
    mass: float,
    current_limit: float,
    actuator: ActuatorParameters,
) -> Loop:
    """The loop of a sampling period in s, a delay in periods (at most 1), and bandwidths in Hz."""
    return Loop(
        period,
        delay_samples * period,
        2.0 * math.pi * amplifier_bandwidth,
        mass,
        current_limit,
        observer_gains(observer_bandwidth, period),
        actuator.constants(),
    )


@compilable
def moment_of_action(
    g: Loop, prior: Estimate, command: float, y: float, r: float, r_dot: float, r_ddot: float
) -> Moment:
    """Estimates and errors for a sample: reading y in m, reference r in m with its rates.

    Args:
        g: the loop.
        prior: the sample as it was predicted.
        command: current in A that is asked of the amplifier until the answer to this sample acts.
    """
    now = corrected(g.observer, prior, y)
    action = predicted(g.actuator, g.mass, g.amplifier_rate, now, command, g.delay)
    target = r + g.delay * (r_dot + 0.5 * g.delay * r_ddot)
    return Moment(now, action, action.y - target, action.velocity - (r_dot + g.delay * r_ddot))


@compilable
def current_for(g: Loop, y: float, acceleration: float) -> float:
    """Control current in A that accelerates the platform at ``y`` (m) by ``acceleration`` (m/s²)."""
    limit = _USABLE_GAP * g.actuator.air_gap
    return control_current(g.actuator, max(-limit, min(limit, y)), g.mass * acceleration)


@compilable
def limited(g: Loop, current: float) -> float:
    """The current within the limit, in A. The observer is told what was asked for: nothing can wind up."""
    return max(-g.current_limit, min(g.current_limit, current))


@compilable
def next_prior(g: Loop, action: Estimate, command: float) -> Estimate:
    """The next sample as it is predicted, with ``command`` A acting from the moment of action on."""
    return predicted(g.actuator, g.mass, g.amplifier_rate, action, command, g.period - g.delay)
