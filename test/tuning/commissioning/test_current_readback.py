"""Gain, bandwidth and delay of the current's way, from commands that change at random."""

import math

import numpy as np
import pytest

from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.tuning.commissioning.machine import Series
from straightcomp_ros.tuning.commissioning.open_loop import current_readback

PERIOD = 5e-4
RANDOM = np.random.default_rng(3)
COMMANDS = np.repeat(RANDOM.uniform(-0.005, 0.005, 250), 2) * np.tile([1.0, -1.0], 250)


def answered(bandwidth: float, delay: float, late: tuple[int, ...] = ()) -> np.ndarray:
    """Current at each sample of a first-order amplifier, computed in steps of a hundredth of a sample.

    The commands ``late`` come half a sample later than the others.
    """
    fine = 100
    drive = DriveParameters()
    commands = np.repeat([drive.converted(command) for command in COMMANDS.tolist()], fine)
    acting = np.concatenate([np.zeros(round(delay * fine)), commands])[: commands.size]
    for place in late:
        due = place * fine + round(delay * fine)
        acting[due : due + fine // 2] = acting[due - 1]
    left, current, seen = math.exp(-2.0 * math.pi * bandwidth * PERIOD / fine), 0.0, []
    for place, command in enumerate(acting.tolist()):
        if place % fine == 0:
            seen.append(current)
        current = command + (current - command) * left
    return np.array(seen)


@pytest.mark.parametrize("delay", [0.0, 0.5, 0.88, 0.95, 1.0, 1.05, 1.4, 2.97])
@pytest.mark.parametrize("bandwidth", [250.0, 480.0, 1000.0])
def test_an_amplifier_is_found_on_both_sides_of_a_whole_sample_of_delay(bandwidth: float, delay: float) -> None:
    found = current_readback(read(0.9 * answered(bandwidth, delay) + 1e-4), DriveParameters(), PERIOD)
    assert found.gain == pytest.approx(0.9, rel=1e-6) and found.offset == pytest.approx(1e-4, rel=1e-6)
    assert found.bandwidth == pytest.approx(bandwidth, rel=1e-5) and found.delay == pytest.approx(delay, abs=1e-5)


@pytest.mark.parametrize("delay", [0.95, 1.0, 1.4])
@pytest.mark.parametrize("bandwidth", [250.0, 350.0, 1000.0])
def test_a_few_late_commands_change_nothing(bandwidth: float, delay: float) -> None:
    late = (50, 51, 130, 222, 223, 301, 390, 460)
    found = current_readback(read(0.9 * answered(bandwidth, delay, late)), DriveParameters(), PERIOD)
    assert found.gain == pytest.approx(0.9, rel=1e-3) and found.bandwidth == pytest.approx(bandwidth, rel=5e-3)
    assert found.delay == pytest.approx(delay, abs=5e-3)


def read(current: np.ndarray) -> Series:
    size = COMMANDS.size
    return Series(
        stamps=(np.arange(size) * PERIOD * 1e9).astype(np.int64),
        x=np.zeros(size),
        y=np.zeros(size),
        current=current,
        command=COMMANDS,
        latency=np.zeros(size),
        left_at=None,
    )
