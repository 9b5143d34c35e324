"""The detector finds what oscillates by itself, fast or slowly, and nothing else."""

import numpy as np
import pytest

from straightcomp_ros.analysis.error_detail import irregular_oscillation, sustained_oscillation, tolerated_amplitude

T = 5e-4
TIME = np.arange(8000) * T
STILL = np.zeros_like(TIME)
NOISE = 0.1e-6 * np.random.default_rng(1).standard_normal(TIME.size)


def sine(frequency: float, period: float = T) -> np.ndarray:
    return 0.3e-6 * np.sin(2.0 * np.pi * frequency * period * np.arange(TIME.size))


@pytest.mark.parametrize(
    ("frequency", "rate"), [*((one, 2000.0) for one in (9.0, 45.0, 190.7, 900.0)), (60.0, 500.0), (60.0, 10_000.0)]
)
def test_a_held_line_is_found_in_noise_with_its_amplitude_and_frequency_at_any_rate(frequency, rate):
    found = sustained_oscillation(sine(frequency, 1.0 / rate) + NOISE, STILL, 1.0 / rate)
    assert found.amplitude == pytest.approx(0.3e-6, rel=0.15)
    assert found.frequency == pytest.approx(frequency, abs=4.0)


def test_a_count_a_part_of_the_deviation_and_a_part_of_the_error_are_no_oscillation_whichever_is_most():
    assert tolerated_amplitude(1e-9 * NOISE, 0.1e-6, 20e-6) == 0.1e-6
    assert tolerated_amplitude(1e-9 * NOISE, 0.0, 20e-6) == pytest.approx(0.08e-6)
    assert tolerated_amplitude(NOISE, 0.0, 0.0) == pytest.approx(0.7 * NOISE.std())
    # A line alone is always one.
    assert tolerated_amplitude(sine(100.0), 0.0, 0.0) < 0.3e-6


@pytest.mark.parametrize(
    "error",
    [
        pytest.param(NOISE, id="white noise"),
        pytest.param(30.0 * sine(3.0), id="what the guide asks for"),
        pytest.param(np.where(TIME % 1.0 < 0.5, 2e-6, -2e-6), id="slips"),
        pytest.param(20.0 * sine(150.0) * np.exp(-TIME / 0.05), id="an answer that dies away"),
        pytest.param(sine(150.0)[:400], id="less than a segment"),
    ],
)
def test_what_is_no_held_line_is_no_oscillation(error):
    assert sustained_oscillation(error, STILL[: error.size], T).amplitude < 0.1e-6


@pytest.mark.parametrize("frequency", [15.0, 60.0, 100.0])
def test_what_the_reference_asks_for_is_no_oscillation_even_where_the_loop_amplifies_it(frequency):
    error, reference = sine(frequency), 0.5 * sine(frequency)
    assert sustained_oscillation(error, reference, T) == (0.0, 0.0)
    assert sustained_oscillation(error, 0.2 * reference, T).amplitude > 0.2e-6


def test_a_loop_that_changes_its_frequency_oscillates_irregularly():
    phase = 2.0 * np.pi * np.cumsum(20.0 + 15.0 * np.sin(2.0 * np.pi * 3.1 * TIME)) * T
    error, guide = 1e-4 * np.sin(phase), 1e-5 * np.sin(2.0 * np.pi * 0.5 * TIME)
    found = irregular_oscillation(error + guide, guide, T)
    assert found.amplitude == pytest.approx(1e-4, rel=0.1)
    assert 5.0 < found.frequency < 35.0
    # What it asks for, the loop may amplify, as above.
    less, more = (irregular_oscillation(error, error / share, T).amplitude for share in (2.7, 3.3))
    assert less == 0.0 < more
    # A platform that stands still does not.
    assert irregular_oscillation(guide, guide, T).amplitude == 0.0
    assert irregular_oscillation(np.where(TIME < 2.0, 0.0, 1e-4), guide, T).amplitude == 0.0
