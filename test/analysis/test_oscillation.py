"""The detector finds what oscillates by itself, fast or slowly, and nothing else."""

import numpy as np
import pytest
from scipy.signal import welch

from straightcomp_ros.analysis.error_detail import (
    error_spectrum,
    irregular_oscillation,
    stretches,
    sustained_oscillation,
    tolerated_amplitude,
)

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
    alone = sustained_oscillation(sine(frequency, 1.0 / rate), STILL, 1.0 / rate)
    assert alone == pytest.approx((0.3e-6, frequency), rel=0.01)


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
        pytest.param(sine(150.0)[:499], id="less than a segment"),
    ],
)
def test_what_is_no_held_line_is_no_oscillation(error):
    found = sustained_oscillation(error, STILL[: error.size], T)
    assert found.amplitude < 1e-9 and (found.amplitude or found == (0.0, 0.0))


@pytest.mark.parametrize("frequency", [15.0, 60.0, 100.0])
def test_what_the_reference_asks_for_is_no_oscillation_even_where_the_loop_amplifies_it(frequency):
    error, reference = sine(frequency), 0.5 * sine(frequency)
    assert sustained_oscillation(error, reference, T) == (0.0, 0.0)
    less, more = (sustained_oscillation(error, error / share, T).amplitude for share in (2.7, 3.3))
    assert less == 0.0 and more == pytest.approx(0.3e-6, rel=0.01)


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
    assert irregular_oscillation(guide, guide, T) == (0.0, 0.0)
    assert irregular_oscillation(np.where(TIME < 2.0, 0.0, 1e-4), guide, T) == (0.0, 0.0)
    # Nor does one whose law shakes it by its own dither, or one of which less than a second is known.
    shaken, second = 1e-4 * np.sin(2.0 * np.pi * 100.0 * TIME), round(1.0 / T)
    assert irregular_oscillation(shaken, guide, T, dither=101.0).amplitude < 1e-7
    assert irregular_oscillation(shaken, guide, T, dither=104.0) == pytest.approx((1e-4, 100.0), rel=1e-3)
    assert irregular_oscillation(shaken[: second - 1], guide[: second - 1], T) == (0.0, 0.0)
    assert irregular_oscillation(shaken[:second], guide[:second], T) == pytest.approx((1e-4, 100.0), rel=1e-3)


def test_the_smallest_amplitude_of_the_segments_in_which_a_line_is_held_is_its_own():
    # As long as four segments that overlap by half, 0.6 s, or not; and after a weaker one.
    for held, amplitude in ((0.8, 0.3e-6), (0.2, 0.0)):
        line = sine(60.0) * (np.abs(TIME - 2.0) < 0.5 * held)
        assert sustained_oscillation(line, STILL, T).amplitude == pytest.approx(amplitude, rel=0.02)
    less = sine(60.0) * np.where(TIME < 2.0, 0.5, 1.0)
    assert sustained_oscillation(less, STILL, T) == pytest.approx((0.3e-6, 60.0), rel=0.02)
    # Of two lines one after the other the strongest has both its amplitude and its frequency.
    both = np.where(TIME < 1.0, sine(60.0), 0.3 * sine(180.0))
    assert sustained_oscillation(both, STILL, T) == pytest.approx((0.3e-6, 60.0), rel=0.02)
    # A line that hops to another frequency for one segment has the frequency of the others.
    hops = np.where(np.abs(TIME - 2.0) < 0.1, sine(180.0), sine(60.0))
    assert sustained_oscillation(hops, STILL, T).frequency == pytest.approx(60.0, rel=0.01)


@pytest.mark.parametrize(("rate", "size"), [(2000.0, 8000), (125.0, 900), (2000.0, 700)])
def test_the_spectrum_is_that_of_another_program_and_of_stretches_their_mean_by_length(rate, size):
    time, random = np.arange(size) / rate, np.random.default_rng(1)
    one, two = random.standard_normal((2, size))
    length = min(round(rate), size)
    settings = {"fs": rate, "window": "hann", "nperseg": length, "noverlap": length // 2, "detrend": "constant"}
    found = error_spectrum(time, one)
    frequency, density = welch(one, **settings)
    assert found.frequency == pytest.approx(frequency) and found.density == pytest.approx(density)
    both = error_spectrum(np.append(time, 1000.0 + time), np.append(one, two))
    assert both.density == pytest.approx(0.5 * (density + welch(two, **settings)[1]))
    if size >= 3 * length:
        third = 2 * length
        unequal = error_spectrum(np.append(time, 1000.0 + time[:third]), np.append(one, two[:third]))
        weights = (size, third)
        expected = np.average([density, welch(two[:third], **settings)[1]], axis=0, weights=weights)
        assert unequal.density == pytest.approx(expected)


def test_single_samples_that_are_missing_are_interpolated_and_a_pause_never():
    time = np.delete(np.arange(1000) * T, [200, 201, *range(500, 545)])
    (a, ramp), (b, line) = stretches(time, time, 2.0 * time)
    assert a == pytest.approx(np.arange(500) * T) and b == pytest.approx(np.arange(545, 1000) * T)
    assert ramp == pytest.approx(2.0 * a) and line == pytest.approx(2.0 * b)
    # 20 ms are filled, of slow samples a single one that is missing is not.
    filled = np.delete(np.arange(1000) * T, range(500, 538))
    assert [one.size for (one,) in stretches(filled, filled)] == [1000]
    slow = np.delete(np.arange(100) * 0.05, [50])
    assert [one.size for (one,) in stretches(slow, slow)] == [50, 49]
