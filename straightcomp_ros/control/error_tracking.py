"""What the observer-based laws share: the error at the moment the command will act, and the current for a force.

A command computed from the sample of time t acts from t + delay on. The law therefore judges the state that the
observer predicts for that moment against the reference of that moment, and answers with an acceleration; the exact
inverse of (2) makes the current of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from straightcomp_ros.control.observer import (
    Estimate,
    Interval,
    ObserverGains,
    corrected,
    interval,
    observer_gains,
    predicted,
)
from straightcomp_ros.model.actuator import Actuator, ActuatorParameters, control_current
from straightcomp_ros.model.compiled import compilable

_USABLE_GAP = 0.95
"""Fraction of the air gap within which the inverse is asked for: it is singular at the poles."""


class Loop(NamedTuple):
    """The loop as a law believes it.

    Attributes:
        period, delay: s.
        before_action, after_action: the two parts of a period, with the last command and with the new one.
        mass: kg.
        current_limit: A.
        current_gain: acceleration per current at the centre, m/s²/A.
        current_share: mean over a period of a current step's effect, relative to its effect at the period's end.
    """

    period: float
    delay: float
    before_action: Interval
    after_action: Interval
    mass: float
    current_limit: float
    current_gain: float
    current_share: float
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
    rate = 2.0 * math.pi * amplifier_bandwidth
    acting = (1.0 - delay_samples) * period
    risen = 1.0 - math.exp(-rate * acting)
    return Loop(
        period,
        delay_samples * period,
        interval(rate, delay_samples * period),
        interval(rate, acting),
        mass,
        current_limit,
        actuator.current_stiffness / mass,
        (acting - risen / rate) / (period * risen) if risen > 0.0 else 0.0,
        observer_gains(observer_bandwidth, period),
        actuator.constants(),
    )


@compilable
def with_measured_current(g: Loop, prior: Estimate, current: float) -> Estimate:
    """The prediction, put right by the current that was really in the coils.

    A command that came late, or not at all, shows there long before it shows in the position. The difference is taken
    to have come in with the command, so that its mean over the period is ``current_share`` of what it is at its end.
    """
    if math.isnan(current):
        return prior
    gained = (current - prior.current) * g.current_share * g.period * g.current_gain
    return Estimate(prior.y + 0.5 * g.period * gained, prior.velocity + gained, prior.disturbance, current)


@compilable
def moment_of_action(
    g: Loop, prior: Estimate, command: float, y: float, r: float, r_dot: float, r_ddot: float, current: float
) -> Moment:
    """Estimates and errors for a sample: reading y in m, reference r in m with its rates.

    Args:
        g: the loop.
        prior: the sample as it was predicted.
        command: current in A that is asked of the amplifier until the answer to this sample acts.
        current: measured in the coils at the sample, A; NaN where it is not measured.
    """
    now = corrected(g.observer, with_measured_current(g, prior, current), y)
    action = predicted(g.actuator, g.mass, g.before_action, now, command)
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
    return predicted(g.actuator, g.mass, g.after_action, action, command)
