"""Friction and stiffness as currents, from position and coil current of a stroke."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from straightcomp_ros.analysis.metrics import force_balance
from straightcomp_ros.offline.simulation import Simulation

RATE = 2000.0
STIFFNESS = 667.0


def stroke(friction: float, noise: float = 0.0, lost: float = 0.0) -> tuple[NDArray[np.float64], ...]:
    """Three waves of ± 10 µm in six seconds, read in counts of 0.1 µm."""
    random = np.random.default_rng(1)
    time = np.arange(0.0, 6.0, 1.0 / RATE)
    y = 10e-6 * np.sin(np.pi * time)
    current = (
        0.01 - STIFFNESS * y + friction * np.sign(np.cos(np.pi * time)) + noise * random.standard_normal(time.size)
    )
    current[random.random(time.size) < lost] = np.nan
    return time, np.round(y / 1e-7) * 1e-7, current


@pytest.mark.parametrize("friction", [0.0, 0.007, 0.02])
def test_friction_is_half_the_hysteresis_and_stiffness_the_slope(friction: float) -> None:
    found = force_balance(*stroke(friction))
    assert found.friction == pytest.approx(friction, abs=2e-5)
    assert found.stiffness == pytest.approx(STIFFNESS, rel=2e-3)


def test_noise_and_missing_currents_hardly_matter() -> None:
    found = force_balance(*stroke(0.007, noise=0.003, lost=0.1))
    assert found.friction == pytest.approx(0.007, abs=1.5e-4)
    assert found.stiffness == pytest.approx(STIFFNESS, rel=0.02)


def test_a_platform_that_rests_tells_nothing() -> None:
    time, y, current = stroke(0.007)
    assert math.isnan(force_balance(time, 0.05 * y, current).friction)
    assert math.isnan(force_balance(time[:200], y[:200], current[:200]).friction)


def test_a_platform_that_only_goes_one_way_does_not_tell_friction_from_an_offset() -> None:
    time = np.arange(0.0, 6.0, 1.0 / RATE)
    assert math.isnan(force_balance(time, 1e-5 * time, -667e-5 * time).friction)


def test_ten_percent_more_friction_of_a_simulated_stage_is_seen_as_nearly_that() -> None:
    found = []
    for factor in (1.0, 1.1):
        coils: list[float] = []
        simulation = Simulation({"driver": {"simulated.truth.friction": factor}})
        record = simulation.run(observe=lambda sample, *_, coils=coils: coils.append(sample.current))
        found.append(force_balance(record.time, record.y, np.array(coils)))
    assert found[1].friction / found[0].friction == pytest.approx(1.1, abs=0.02)
    assert found[0].friction == pytest.approx(0.0075, abs=0.001)
