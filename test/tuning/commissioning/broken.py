"""Machines that are broken in ways that no parameter describes."""

from collections.abc import Callable, Sequence

import numpy as np

from straightcomp_ros.hardware.interface import Sample, Truth
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.model.plant import BIAS
from trials.faulty_machine import FaultyHardware


class Rewired(FaultyHardware):
    """Another machine of which each sample is changed, or lost where ``change`` gives None."""

    def __init__(self, inner: SimulatedHardware, change: Callable[[Sample], Sample | None]) -> None:
        super().__init__(inner, lambda kind, at_ns: None)
        self._change = change

    def read(self, now_ns: int) -> Sequence[tuple[Sample, Truth | None]]:
        changed = [(self._change(sample), truth) for sample, truth in super().read(now_ns)]
        return [(sample, truth) for sample, truth in changed if sample is not None]


def rewired(change: Callable[[Sample], Sample | None]) -> Callable[[SimulatedHardware], Rewired]:
    return lambda hardware: Rewired(hardware, change)


readback_backwards = rewired(lambda sample: sample._replace(current=-sample.current))
readback_of_half_the_scale = rewired(lambda sample: sample._replace(current=0.5 * sample.current))
readback_dead = rewired(lambda sample: sample._replace(current=0.0 * sample.current))
readback_with_an_offset = rewired(lambda sample: sample._replace(current=sample.current + 0.1))
encoder_backwards = rewired(lambda sample: sample._replace(y=-sample.y))
encoder_dead = rewired(lambda sample: sample._replace(y=0.0))
# Each count is twice as long as described, so that half of the way is read.
encoder_of_twice_the_count = rewired(lambda sample: sample._replace(y=round(0.5 * sample.y / 1e-7) * 1e-7))


def lossy_bus(hardware: SimulatedHardware) -> Rewired:
    random = np.random.default_rng(1)
    return Rewired(hardware, lambda sample: None if random.random() < 0.01 else sample)


def noisy_encoder(hardware: SimulatedHardware) -> Rewired:
    """Ten times the described noise of half a count."""
    random = np.random.default_rng(1)
    return Rewired(hardware, lambda sample: sample._replace(y=sample.y + 1e-7 * round(random.normal(0.0, 5.0))))


class OneCoilDead(Rewired):
    """The coil of the far magnet carries no current.

    The other one's, I0 + i, is what (2) makes of half of it as bias and half of it as control current; and half of it
    is what the board measures as the difference of both coils.
    """

    def __init__(self, inner: SimulatedHardware) -> None:
        super().__init__(inner, lambda sample: sample)
        self._half = 0.5 * inner._bias

    def enable(self) -> None:
        super().enable()
        assert isinstance(self._inner, SimulatedHardware)
        self._inner._plant.state[BIAS] = self._half
        super().write(self._half, 0)

    def write(self, current: float, at_ns: int, sample_ns: int | None = None) -> None:
        super().write(self._half + 0.5 * current, at_ns, sample_ns)
