"""Friction from what a machine records: F = f_c(y, i_c) − M ÿ by (1) and (2).

y, ẏ and ÿ come from a cubic fitted to the encoder's readings in a moving window (Savitzky and Golay,
Analytical Chemistry 36(8), 1964), and the current is smoothed by the same window, so that all are of the
same time, without lag. A window of 20 ms makes an encoder quantum of 0.1 µm at 2 kHz a noise of 0.3 mm/s²
in ÿ (1 mN at 3 kg); what friction does faster than that is smoothed away.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from straightcomp_ros.model.actuator import ActuatorParameters, magnetic_force

WINDOW = 0.02
"""Length of the moving window in s."""
_ORDER = 3


@dataclass(frozen=True, eq=False)
class FrictionEstimate:
    """Velocity in m/s and friction in N, both (n,); friction is positive where it resists a positive velocity."""

    velocity: NDArray[np.float64]
    friction: NDArray[np.float64]


def smoothed(values: NDArray[np.float64], rate: float, derivative: int = 0) -> NDArray[np.float64]:
    """Value or derivative in time of the moving cubic through ``values`` (n,) at ``rate`` samples per second."""
    samples = 2 * round(0.5 * WINDOW * rate) + 1
    return np.asarray(savgol_filter(values, samples, _ORDER, deriv=derivative, delta=1.0 / rate))


def estimate_friction(
    y: NDArray[np.float64], current: NDArray[np.float64], *, rate: float, mass: float, actuator: ActuatorParameters
) -> FrictionEstimate:
    """Estimate velocity and friction from a record; the ends, half a window long, are less certain.

    The magnets' negative stiffness counts: an error of 1 µm in where y is zero is 30 mN with the magnets of
    the shipped parameters.

    Args:
        y: (n,) encoder readings in m.
        current: (n,) measured control current in A.
        rate: samples per second.
        mass: M in kg.
        actuator: the magnets, as far as they are known.
    """
    constants, bias = actuator.constants(), actuator.bias_current
    # (2) is arithmetic only: arrays pass through it as numbers do.
    force = magnetic_force(constants, smoothed(y, rate), bias, smoothed(current, rate))  # type: ignore[arg-type]
    return FrictionEstimate(smoothed(y, rate, 1), force - mass * smoothed(y, rate, 2))
