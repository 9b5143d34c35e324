"""Extended state observer of the platform: position, velocity, disturbance, through a loop delay that it knows.

The model between two samples is M v̇ = f_c(y, i) + M d with the magnets' exact force (2), the amplifier's
first-order lag, and a command that takes effect ``delay`` after its sample. Friction, model errors and everything else
is the disturbance d (an acceleration), taken as constant from sample to sample (Han, IEEE Trans. Ind. Electron. 56(3),
2009; Gao's bandwidth parameterisation, ACC 2003).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from straightcomp_ros.model.actuator import Actuator, magnetic_force
from straightcomp_ros.model.compiled import compilable


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


def observer_gains(bandwidth: float, period: float) -> ObserverGains:
    """Gains that put all three poles of the sampled observer at exp(−2π·bandwidth·period).

    Args:
        bandwidth: Hz.
        period: sampling period in s.
    """
    pole = math.exp(-2.0 * math.pi * bandwidth * period)
    return ObserverGains(
        1.0 - pole**3,
        1.5 * (1.0 - pole) ** 2 * (1.0 + pole) / period,
        (1.0 - pole) ** 3 / period**2,
    )


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


class Interval(NamedTuple):
    """A time for which the amplifier is asked for one current, and how the coils follow.

    Attributes:
        duration: s.
        left: of the difference between the coils' current and the one asked for, at its end; 1 at its start.
        mean: of that difference over the interval.
    """

    duration: float
    left: float
    mean: float


def interval(amplifier_rate: float, duration: float) -> Interval:
    """An interval of ``duration`` s, zero or more, with an amplifier of first order, rad/s."""
    left = math.exp(-amplifier_rate * duration)
    return Interval(duration, left, (1.0 - left) / (amplifier_rate * duration) if duration > 0.0 else 1.0)


@compilable
def predicted(actuator: Actuator, mass: float, over: Interval, estimate: Estimate, command: float) -> Estimate:
    """The estimate at the end of ``over``, with the amplifier asked for ``command`` A throughout."""
    y, velocity, disturbance, current = estimate
    duration, left, mean = over
    behind = current - command
    halfway = y + 0.5 * duration * velocity
    # The model must not leave the air gap, wherever the estimate strays.
    limit = 0.95 * actuator.air_gap
    if halfway > limit:
        halfway = limit
    elif halfway < -limit:
        halfway = -limit
    force = magnetic_force(actuator, halfway, actuator.bias_current, command + behind * mean)
    acceleration = force / mass + disturbance
    return Estimate(
        y + duration * (velocity + 0.5 * duration * acceleration),
        velocity + duration * acceleration,
        disturbance,
        command + behind * left,
    )
