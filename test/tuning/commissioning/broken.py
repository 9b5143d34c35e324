"""Machines that are broken in ways that no parameter describes: what puts them between a machine and its driver."""

import numpy as np

from straightcomp_ros.model.plant import BIAS


def rewired(change):
    """Each sample is changed, or lost where ``change`` gives None."""

    def wiring(hardware):
        read = hardware.read

        def changed(now_ns):
            samples = [(change(sample), truth) for sample, truth in read(now_ns)]
            return [(sample, truth) for sample, truth in samples if sample is not None]

        hardware.read = changed
        return hardware

    return wiring


readback_backwards = rewired(lambda sample: sample._replace(current=-sample.current))
readback_of_half_the_scale = rewired(lambda sample: sample._replace(current=0.5 * sample.current))
readback_dead = rewired(lambda sample: sample._replace(current=0.0 * sample.current))
readback_with_an_offset = rewired(lambda sample: sample._replace(current=sample.current + 0.1))
encoder_backwards = rewired(lambda sample: sample._replace(y=-sample.y))
encoder_dead = rewired(lambda sample: sample._replace(y=0.0))
# Each count is twice as long as described, so that half of the way is read.
encoder_of_twice_the_count = rewired(lambda sample: sample._replace(y=round(0.5 * sample.y / 1e-7) * 1e-7))


def lossy_bus(hardware):
    random = np.random.default_rng(1)
    return rewired(lambda sample: None if random.random() < 0.01 else sample)(hardware)


def noisy_encoder(hardware):
    """Ten times the described noise of half a count."""
    random = np.random.default_rng(1)
    return rewired(lambda sample: sample._replace(y=sample.y + 1e-7 * round(random.normal(0.0, 5.0))))(hardware)


def one_coil_dead(hardware):
    """The coil of the far magnet carries no current.

    The other one's, I0 + i, is what (2) makes of half of it as bias and half of it as control current; and half of it
    is what the board measures as the difference of both coils.
    """
    half, enable, write = 0.5 * hardware._bias, hardware.enable, hardware.write

    def enabled():
        enable()
        hardware._plant.state[BIAS] = half
        write(half, 0)

    hardware.enable = enabled
    hardware.write = lambda current, at_ns, sample_ns=None: write(half + 0.5 * current, at_ns, sample_ns)
    return hardware
