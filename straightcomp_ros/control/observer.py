"""Extended state observer of the platform, through a loop delay that it knows; and the errors at the moment of action.

The model between two samples is M v̇ = f_c(y, i) − k y + M d with the magnets' exact force (2), a flexure's
stiffness k, the amplifier's first-order lag, and a command that takes effect ``delay`` after its sample. Friction,
model errors and everything else is the disturbance d (an acceleration), taken as constant from sample to sample (Han,
IEEE Trans. Ind. Electron. 56(3), 2009; Gao's bandwidth parameterisation, ACC 2003).

The command computed from the sample of time t acts at t + delay: the laws compare the state predicted for that moment
with the reference of that moment. They answer with an acceleration; the exact inverse of (2) gives the current.
"""

import math
from typing import NamedTuple

from straightcomp_ros.model.actuator import Actuator, control_current, magnetic_force
from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.stage.description import StageParameters

_USABLE_GAP = 0.95
"""Fraction of the air gap within which (2) and its inverse are evaluated: they are singular at the poles."""


class Estimate(NamedTuple):
    """Position m, velocity m/s, disturbance m/s², control current in the coils A."""

    y: float
    velocity: float
    disturbance: float
    current: float


class ObserverGains(NamedTuple):
    """Correction of position (1), velocity (1/s) and disturbance (1/s²) by one metre of innovation."""

    position: float
    velocity: float
    disturbance: float


class Interval(NamedTuple):
    """A time for which the amplifier is commanded one current.

    Attributes:
        duration: s.
        left: remaining fraction, at the end, of the initial difference between the coils' current and the command.
        mean: mean of that fraction over the interval.
    """

    duration: float
    left: float
    mean: float


class Loop(NamedTuple):
    """The nominal model of the loop.

    Attributes:
        period, delay: s.
        before_action, after_action: of a period, under the last command and under the new one.
        mass: kg.
        stiffness: of the flexure, N/m.
        current_limit: A.
        current_gain: acceleration per current at the centre, m/s²/A.
        current_share: mean over a period of a current step's effect, relative to its effect at the period's end.
    """

    period: float
    delay: float
    before_action: Interval
    after_action: Interval
    mass: float
    stiffness: float
    current_limit: float
    current_gain: float
    current_share: float
    actuator: Actuator


def observer_gains(bandwidth: float, third_pole: float, period: float) -> ObserverGains:
    """Gains that put two poles of the sampled observer at exp(−2π bandwidth period), the third at the power
    ``third_pole`` of it, its bandwidth relative to the other two; ``bandwidth`` in Hz, ``period`` in s."""
    p = math.exp(-2.0 * math.pi * bandwidth * period)
    q = math.exp(-2.0 * math.pi * bandwidth * third_pole * period)
    # 3 − s₁ − s₂ + 3 s₃ with the elementary symmetric polynomials of the poles.
    velocity = 3.0 - (2.0 * p + q) - (p * p + 2.0 * p * q) + 3.0 * p * p * q
    return ObserverGains(1.0 - p * p * q, 0.5 * velocity / period, (1.0 - p) ** 2 * (1.0 - q) / period**2)


def interval(amplifier_rate: float, duration: float) -> Interval:
    """An interval of ``duration`` s, zero or more, with an amplifier of first order, rad/s."""
    left = math.exp(-amplifier_rate * duration)
    return Interval(duration, left, (1.0 - left) / (amplifier_rate * duration) if duration > 0.0 else 1.0)


def nominal_loop(stage: StageParameters, *, delay_samples: float, gain_allowance: float = 1.0) -> Loop:
    """The loop around the stage's plant, with commands ``delay_samples`` periods late, at most 1.

    ``gain_allowance`` is a factor of the stiffnesses K̄_i and K̄_y. It equals dividing M; the equilibrium does not move.
    """
    rate, period = 2.0 * math.pi * stage.drive.bandwidth, stage.period
    mass = stage.platform.mass / gain_allowance
    acting = (1.0 - delay_samples) * period
    risen = 1.0 - math.exp(-rate * acting)
    return Loop(
        period,
        delay_samples * period,
        interval(rate, delay_samples * period),
        interval(rate, acting),
        mass,
        stage.platform.stiffness,
        stage.highest_current,
        stage.actuator.current_stiffness / mass,
        (acting - risen / rate) / (period * risen) if risen > 0.0 else 0.0,
        stage.actuator.constants(),
    )


@compilable
def with_mass(g: Loop, mass: float) -> Loop:
    """The model with another ``mass`` in kg."""
    gain = g.current_gain * (g.mass / mass)
    return Loop(*g[:4], mass, g.stiffness, g.current_limit, gain, g.current_share, g.actuator)


@compilable
def corrected(gains: ObserverGains, prior: Estimate, reading: float) -> Estimate:
    """The estimate for a sample, from its prediction and the encoder's reading in m."""
    innovation = reading - prior.y
    return Estimate(
        prior.y + gains.position * innovation,
        prior.velocity + gains.velocity * innovation,
        prior.disturbance + gains.disturbance * innovation,
        prior.current,
    )


@compilable
def predicted(
    actuator: Actuator, mass: float, over: Interval, estimate: Estimate, command: float, stiffness: float = 0.0
) -> Estimate:
    """The estimate at the end of ``over``, with the amplifier commanded ``command`` A throughout, and the ``stiffness``
    of a flexure in N/m."""
    y, velocity, disturbance, current = estimate
    duration, left, mean = over
    behind = current - command
    # The model must not leave the air gap, wherever the estimate strays.
    limit = _USABLE_GAP * actuator.air_gap
    halfway = max(-limit, min(limit, y + 0.5 * duration * velocity))
    force = magnetic_force(actuator, halfway, actuator.bias_current, command + behind * mean)
    acceleration = (force - stiffness * halfway) / mass + disturbance
    return Estimate(
        y + duration * (velocity + 0.5 * duration * acceleration),
        velocity + duration * acceleration,
        disturbance,
        command + behind * left,
    )


@compilable
def with_measured_current(g: Loop, prior: Estimate, current: float) -> Estimate:
    """The prediction, corrected by the measured current of the coils (A; not finite: none).

    A late or lost command shows there long before it shows in the position. The difference is assumed to have begun
    with the command, so that its mean over the period is ``current_share`` of its value at the end.
    """
    if not math.isfinite(current):
        return prior
    gained = (current - prior.current) * g.current_share * g.period * g.current_gain
    return Estimate(prior.y + 0.5 * g.period * gained, prior.velocity + gained, prior.disturbance, current)


@compilable
def moment_of_action(
    g: Loop, now: Estimate, command: float, r: float, r_dot: float, r_ddot: float
) -> tuple[Estimate, float, float]:
    """Estimate and errors y − r and ẏ − ṙ at the moment at which the answer to a sample acts, from the estimate
    ``now``, the ``command`` in A until then, and the reference of the sample in m, m/s, m/s²."""
    action = predicted(g.actuator, g.mass, g.before_action, now, command, g.stiffness)
    target = r + g.delay * (r_dot + 0.5 * g.delay * r_ddot)
    return action, action.y - target, action.velocity - (r_dot + g.delay * r_ddot)


@compilable
def current_for(g: Loop, y: float, acceleration: float) -> float:
    """Control current in A that accelerates the platform at ``y`` (m) by ``acceleration`` (m/s²)."""
    limit = _USABLE_GAP * g.actuator.air_gap
    y = max(-limit, min(limit, y))
    return control_current(g.actuator, y, g.mass * acceleration + g.stiffness * y)


@compilable
def limited(limit: float, current: float) -> float:
    """The current within ± ``limit``, A. The observer is given the limited command: nothing can wind up.

    In this order of the arguments NaN stays NaN, which the driver refuses; in the other it would become the limit.
    """
    return min(max(current, -limit), limit)
