"""What is an outlier within a run and among runs: Hampel's identifier, on made-up deviations."""

import numpy as np
import pytest
from numpy.typing import NDArray
from straightcomp_ros.straightness.survey_runs import FLOOR, disagreement, spikes

LIMIT = 6.0
N = 100
GUIDE = 1e-5 * np.sin(np.linspace(0.0, 6.0, N))


def runs(count: int, noise: float = 50e-9, seed: int = 1) -> NDArray[np.float64]:
    """Runs over a guide that agree within ``noise`` in m."""
    return np.asarray(GUIDE + np.random.default_rng(seed).normal(0.0, noise, (count, N)))


def test_a_spike_is_told_by_the_robust_standard_deviation_of_the_rest() -> None:
    residual = np.random.default_rng(2).normal(3e-6, 100e-9, 1000)
    sigma = 1.4826 * np.median(np.abs(residual - np.median(residual)))
    middle = np.median(residual)
    for place, away in ((10, 1.02), (20, -1.02), (30, 0.98), (40, -0.98)):
        residual[place] = middle + away * LIMIT * sigma
    assert np.flatnonzero(spikes(residual, LIMIT)).tolist() == [10, 20]


def test_below_the_floor_nothing_is_an_outlier() -> None:
    residual = np.zeros(100)
    residual[[5, 6]] = 0.99 * FLOOR, 1.01 * FLOOR
    assert np.flatnonzero(spikes(residual, LIMIT)).tolist() == [6]
    values = runs(4, noise=0.5e-9)
    values[1, [5, 6]] += (0.9 * FLOOR, 1.1 * FLOOR)
    assert np.argwhere(disagreement(values, LIMIT).points).tolist() == [[1, 6]]


@pytest.mark.parametrize("count", [3, 4, 7])
def test_runs_that_agree_are_kept_whole_wherever_the_guide_goes(count: int) -> None:
    found = disagreement(runs(count), LIMIT)
    assert not found.runs.any() and not found.points.any()


def test_single_points_that_no_other_run_confirms_are_rejected() -> None:
    values = runs(5)
    values[2, 40:43] += 2e-6
    values[4, 70] -= 2e-6
    found = disagreement(values, LIMIT)
    assert not found.runs.any()
    assert np.argwhere(found.points).tolist() == [[2, 40], [2, 41], [2, 42], [4, 70]]


def test_four_neighbours_reject_the_run() -> None:
    values = runs(5)
    values[2, 40:44] += 2e-6
    found = disagreement(values, LIMIT)
    assert found.runs.tolist() == [False, False, True, False, False] and not found.points.any()


def test_a_run_is_rejected_from_more_than_a_quarter_of_its_points_on() -> None:
    for bad, rejected in ((25, False), (26, True)):
        values = runs(5)
        places = np.arange(bad) * 3
        values[1, places] += 2e-6
        found = disagreement(values, LIMIT)
        assert found.runs[1] == rejected and found.runs.sum() == rejected
        assert np.flatnonzero(found.points[1]).tolist() == ([] if rejected else places.tolist())


def test_runs_are_rejected_one_by_one_the_worst_first() -> None:
    values = runs(7)
    values[5] += 9e-6
    values[0] -= 3e-6
    found = disagreement(values, LIMIT)
    assert np.flatnonzero(found.runs).tolist() == [0, 5] and not found.points.any()


def test_of_two_runs_neither_is_the_wrong_one() -> None:
    values = runs(2)
    values[1] += 9e-6
    found = disagreement(values, LIMIT)
    assert not found.runs.any() and not found.points.any()


def test_identical_runs_have_no_outlier() -> None:
    found = disagreement(np.tile(GUIDE, (3, 1)), LIMIT)
    assert not found.runs.any() and not found.points.any()
