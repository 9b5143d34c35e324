"""The run of Fig. 6 and 7: the machine, under linear control, follows a slow sine."""

import math

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.tuning.paper.ideal_machine import Machine
from straightcomp_ros.tuning.paper.release import Response, release

FREQUENCY = 0.8
"""Hz."""
AMPLITUDE = 50e-6
"""m."""
SETTLING_PERIODS = 2
PERIODS = 2
"""Periods that are evaluated, after those in which the loop settles."""
OMEGA = 2.0 * math.pi * FREQUENCY


def follow_sine(machine: Machine) -> Response:
    """Run the loop from rest; the platform's friction is whatever the machine has."""
    count = round((SETTLING_PERIODS + PERIODS) / FREQUENCY * machine.stage.rate)
    reference = AMPLITUDE * np.sin(OMEGA * np.arange(count) / machine.stage.rate)
    return release(machine, 0.0, reference)


def evaluated(response: Response) -> NDArray[np.bool_]:
    """(n,) whether a sample lies in the periods that are evaluated."""
    return np.asarray(response.time >= SETTLING_PERIODS / FREQUENCY - 1e-9)


def fundamental(time: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """Amplitude of the part of ``values`` at the sine's frequency, over whole periods."""
    return 2.0 * abs(complex(np.mean(values * np.exp(-1j * OMEGA * time))))
