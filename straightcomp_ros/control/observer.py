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


@compilable
def predicted(
    actuator: Actuator, mass: float, amplifier_rate: float, estimate: Estimate, command: float, duration: float
) -> Estimate:
    """The estimate ``duration`` s later, with the amplifier asked for ``command`` A throughout."""
    if duration <= 0.0:
        return estimate
    decay = math.exp(-amplifier_rate * duration)
    mean = command + (estimate.current - command) * (1.0 - decay) / (amplifier_rate * duration)
    halfway = estimate.y + 0.5 * duration * estimate.velocity
    # The model must not leave the air gap, wherever the estimate strays.
    limit = 0.95 * actuator.air_gap
    halfway = max(-limit, min(limit, halfway))
    acceleration = magnetic_force(actuator, halfway, actuator.bias_current, mean) / mass + estimate.disturbance
    return Estimate(
        estimate.y + duration * (estimate.velocity + 0.5 * duration * acceleration),
        estimate.velocity + duration * acceleration,
        estimate.disturbance,
        command + (estimate.current - command) * decay,
    )
