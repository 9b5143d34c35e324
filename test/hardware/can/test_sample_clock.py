import itertools

import numpy as np
import pytest

from straightcomp_ros.hardware.can.sample_numbers import BLOCK, SampleClock

PERIOD = 500_000
START = 1_700_000_000_123_456_789


def followed(ppm, lateness_ns, lost=0.0, count=40_000, seed=1):
    """Errors in ns of the stamps as they are given, and the stamps."""
    random = np.random.default_rng(seed)
    clock, errors, stamps = SampleClock(PERIOD), [], []
    for index in range(count):
        true_ns = START + round(index * PERIOD * (1 + ppm * 1e-6))
        if random.random() < lost:
            continue
        clock.observe(index, true_ns + round(lateness_ns(index, random)))
        if clock.settled:
            stamps.append(clock.stamp(index))
            errors.append(stamps[-1] - true_ns)
    return np.array(errors), stamps


@pytest.mark.parametrize("ppm", [-100, 0, 100])
def test_the_clock_follows_a_quartz_through_jitter_and_losses(ppm):
    errors, stamps = followed(ppm, lambda _, random: 100_000 + random.exponential(60_000), lost=0.05)
    settled = errors[20 * BLOCK :]
    # Late by the promptest frame's 100 µs, to a fiftieth of a period.
    assert np.abs(settled - 100_000).max() < PERIOD / 50
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))


def test_a_stall_of_the_host_does_not_drag_the_clock_along():
    def lateness(index, random):
        stall_end = 20_000 + 400
        return (stall_end - index) * PERIOD if 20_000 <= index < stall_end else random.exponential(20_000)

    errors, _ = followed(50, lateness)
    assert np.abs(errors[15_000:]).max() < PERIOD / 5


def test_a_first_sample_that_is_late_does_not_make_all_stamps_late():
    errors, _ = followed(0, lambda index, _: 20_000_000 - 500_000 * index if index < 40 else 0, count=1000)
    assert np.abs(errors).max() < 100


def test_a_clock_that_was_interrupted_is_found_again():
    clock = SampleClock(PERIOD)
    for index in range(4000):
        clock.observe(index, START + index * PERIOD + (50 * PERIOD if index > 2000 else 0))
    assert clock.settled and clock.stamp(4000) - (START + 4050 * PERIOD) == pytest.approx(0, abs=1)


def test_time_gives_the_number_of_samples_since():
    clock = SampleClock(PERIOD)
    for index in range(BLOCK):
        clock.observe(index, START + index * PERIOD)
    assert clock.elapsed(BLOCK - 1, START + (BLOCK + 6) * PERIOD) == pytest.approx(7)


def test_a_line_that_was_drawn_too_late_is_drawn_in_as_soon_as_frames_come_early():
    errors, stamps = followed(0, lambda index, _: 5_000_000 if index < 2 * BLOCK else 0, count=20 * BLOCK)
    assert errors[0] == 5_000_000 and np.abs(errors[12 * BLOCK :]).max() < PERIOD / 5
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))
