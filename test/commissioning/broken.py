"""Machines that are broken in ways that no parameter describes."""

from collections.abc import Callable, Sequence

import numpy as np

from straightcomp_ros.hardware.interface import Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.trials.faults.faulty_machine import FaultyHardware


class Rewired(FaultyHardware):
    """Another machine of which each sample is changed, or lost where ``change`` gives None."""

    def __init__(self, inner: SimulatedHardware, change: Callable[[Sample], Sample | None]) -> None:
        super().__init__(inner, lambda kind, at_ns: None)
        self._change = change

    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        changed = [(self._change(sample), truth) for sample, truth in super().read(now_ns)]
        return [(sample, truth) for sample, truth in changed if sample is not None]


def readback_backwards(hardware: SimulatedHardware) -> Rewired:
    return Rewired(hardware, lambda sample: sample._replace(current=-sample.current))


def readback_of_half_the_scale(hardware: SimulatedHardware) -> Rewired:
    return Rewired(hardware, lambda sample: sample._replace(current=0.5 * sample.current))


def encoder_backwards(hardware: SimulatedHardware) -> Rewired:
    return Rewired(hardware, lambda sample: sample._replace(y=-sample.y))


def encoder_of_twice_the_count(hardware: SimulatedHardware) -> Rewired:
    """Each count is twice as long as described, so that half of the way is read."""
    return Rewired(hardware, lambda sample: sample._replace(y=round(0.5 * sample.y / 1e-7) * 1e-7))


def encoder_dead(hardware: SimulatedHardware) -> Rewired:
    return Rewired(hardware, lambda sample: sample._replace(y=0.0))


def lossy_bus(hardware: SimulatedHardware) -> Rewired:
    random = np.random.default_rng(1)
    return Rewired(hardware, lambda sample: None if random.random() < 0.01 else sample)
