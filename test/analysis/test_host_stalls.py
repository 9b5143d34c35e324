"""Stalls of the host are found in what a bag knows: lost samples, missing and late commands, a late driver."""

import numpy as np
import pytest

from straightcomp_ros.analysis.interruption import stalls_of

PERIOD_NS = 500_000
SAMPLES = np.arange(2000, dtype=np.int64) * PERIOD_NS


def driver(**changes: dict[int, float]) -> dict[str, np.ndarray]:
    """The driver's record of a quiet run, with other values at some samples."""
    columns = {
        "command_latency": np.full(SAMPLES.size, 150e-6),
        "lateness": np.full(SAMPLES.size, 40e-6),
        "enabled": np.ones(SAMPLES.size),
    }
    for name, values in changes.items():
        for place, value in values.items():
            columns[name][place] = value
    return columns


def test_a_quiet_run_has_no_stall():
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver()) == []
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES[:0], {}) == []


def test_lost_samples_are_a_stall_from_the_sample_before_to_the_one_after():
    left = np.delete(SAMPLES, range(1000, 1010))
    (stall,) = stalls_of(left, left, left[:0], {})
    assert stall == pytest.approx((999 * 5e-4, 1010 * 5e-4))


def test_samples_without_a_command_are_one_stall_and_those_after_the_last_command_are_none():
    answered = np.delete(SAMPLES, [*range(300, 303), *range(1990, 2000)])
    (stall,) = stalls_of(SAMPLES, answered, SAMPLES[:0], {})
    assert stall == pytest.approx((300 * 5e-4, 303 * 5e-4))


def test_a_late_command_and_a_late_sample_are_stalls_and_jitter_below_a_period_is_none():
    (stall,) = stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency={700: 5e-3, 900: 600e-6}))
    assert stall == pytest.approx((700 * 5e-4 - 5.5e-3, 700 * 5e-4))
    (stall,) = stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(lateness={700: 5e-3, 900: 500e-6}))
    assert stall == pytest.approx((700 * 5e-4, 700 * 5e-4 + 5e-3))


def test_a_controller_that_is_silent_is_a_stall_while_the_amplifier_is_on():
    silent = dict.fromkeys(range(400, 420), np.nan)
    (stall,) = stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency=silent))
    assert stall == pytest.approx((399 * 5e-4, 419 * 5e-4))
    off = dict.fromkeys(range(400, 420), 0.0)
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency=silent, enabled=off)) == []
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency={400: np.nan})) == []


def test_a_delay_that_is_always_the_same_is_no_stall_however_long():
    columns = driver() | {"command_latency": np.full(SAMPLES.size, 5.0 * 5e-4)}
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, columns) == []


def test_a_controller_that_answers_several_samples_at_once_does_not_stall():
    in_batches = dict.fromkeys((k for k in range(2000) if k % 4), np.nan)
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency=in_batches)) == []
