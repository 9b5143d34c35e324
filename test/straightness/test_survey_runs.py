"""The runs of a survey together: on one grid, their repeatability by its definition, and outliers."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from straightcomp_ros.straightness.survey import Direction, Run, Survey, SurveyError
from straightcomp_ros.straightness.survey_runs import (
    FLOOR,
    disagreement,
    on_common_grid,
    repeatability,
    spikes,
)

X = np.linspace(0.0, 1.0, 101)


def _bow(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1e-5 * np.sin(3.0 * x)


def _run(direction: Direction, offset: float = 0.0, x: NDArray[np.float64] = X) -> Run:
    return Run("1", direction, x, _bow(x) + offset)


def _grid(*runs: Run) -> tuple[NDArray[np.float64], NDArray[np.float64], Survey]:
    survey = Survey(runs)
    return *on_common_grid(survey, min_points=20, max_gap=0.05), survey


def test_runs_on_the_same_x_are_taken_as_measured() -> None:
    x, values, _ = _grid(_run("forward"), _run("backward", 1e-7))
    np.testing.assert_array_equal(x, X)
    np.testing.assert_array_equal(values, [_bow(X), _bow(X) + 1e-7])


def test_a_run_on_other_x_is_brought_onto_the_first_ones_grid() -> None:
    shifted = np.linspace(0.0, 1.0, 83)
    x, values, _ = _grid(_run("forward"), _run("backward", x=shifted))
    np.testing.assert_array_equal(x, X)
    np.testing.assert_allclose(values[1], _bow(X), atol=1e-12)


def test_the_grid_keeps_to_what_all_runs_cover() -> None:
    x, values, _ = _grid(_run("forward"), _run("backward", x=np.linspace(0.0012, 0.9988, 101)))
    assert (x[0], x[-1]) == (0.0012, 0.9988)
    assert np.diff(x).min() > 0.005
    np.testing.assert_allclose(values[0], _bow(x), atol=1e-12)


def test_directions_weigh_the_same_whatever_the_number_of_their_runs() -> None:
    x, values, survey = _grid(_run("forward", 0.0), _run("forward", 0.0), _run("forward", 0.0), _run("backward", 4e-8))
    np.testing.assert_allclose(repeatability(survey, x, values).mean, _bow(X) + 2e-8, rtol=1e-12)


def test_a_run_that_was_broken_off_is_refused() -> None:
    with pytest.raises(SurveyError, match=r"runs end between x = 500 mm and 1000 mm.*within 50 mm.*broken off"):
        _grid(_run("forward"), _run("backward", x=np.linspace(0.0, 0.5, 51)))


def test_too_few_common_points_are_refused() -> None:
    with pytest.raises(SurveyError, match="11 points in the range that all runs cover; allowed: >= 20"):
        _grid(_run("forward", x=np.linspace(0.0, 1.0, 11)))


def test_a_survey_without_a_run_is_refused() -> None:
    with pytest.raises(SurveyError, match="no run"):
        _grid()


FOUR = np.arange(4) * 0.01


def found_of(forward, backward):
    """Repeatability of runs given as rows of deviations in µm at four points."""
    rows = [("forward", row) for row in forward] + [("backward", row) for row in backward]
    runs = tuple(Run(str(i), way, FOUR, np.array(row) * 1e-6) for i, (way, row) in enumerate(rows))
    return repeatability(Survey(runs), FOUR, np.array([run.deviation for run in runs]))


def test_the_figures_are_those_of_the_standard_at_the_worst_point():
    found = found_of([[1, 0, 0, 0], [3, 0, 0, 0]], [[0, 0, 0, 5], [0, 0, 0, 9]])
    s_forward, s_backward = math.sqrt(2.0), 2.0 * math.sqrt(2.0)
    shown = found.to_display()
    assert shown["repeatability_forward_um"] == pytest.approx(4.0 * s_forward)
    assert shown["repeatability_backward_um"] == pytest.approx(4.0 * s_backward)
    assert found.reversal == pytest.approx([2e-6, 0.0, 0.0, -7e-6])
    assert shown["reversal_max_um"] == pytest.approx(7.0) and shown["reversal_mean_um"] == pytest.approx(-1.25)
    assert shown["repeatability_bidirectional_um"] == pytest.approx(2.0 * s_backward + 7.0)


def test_the_bidirectional_figure_adds_the_spreads_of_both_directions_and_the_reversal():
    found = found_of([[1, 0, 0, 0], [3, 0, 0, 0]], [[0, 0, 0, 0], [4, 0, 0, 0]])
    # s: √2 and 2√2 µm, no reversal.
    assert found.bidirectional == pytest.approx(max(6.0 * math.sqrt(2.0), 8.0 * math.sqrt(2.0)) * 1e-6)
    turned = found_of([[0, 0, 0, 0], [4, 0, 0, 0]], [[2, 0, 0, 0], [2, 0, 0, 0]])
    assert turned.bidirectional == pytest.approx(8.0 * math.sqrt(2.0) * 1e-6)
    apart = found_of([[11, 0, 0, 0], [13, 0, 0, 0]], [[0, 0, 0, 0], [4, 0, 0, 0]])
    assert apart.bidirectional == pytest.approx((6.0 * math.sqrt(2.0) + 10.0) * 1e-6)


def test_what_was_not_driven_twice_or_not_both_ways_has_no_figure():
    one = found_of([[1, 2, 3, 4]], []).to_display()
    assert set(one.values()) == {None}
    both = found_of([[1, 1, 1, 1], [1, 1, 1, 1]], [[0, 0, 0, 0]])
    assert both.bidirectional is None and both.backward.s is None and both.forward.repeatability == 0.0
    assert both.to_display()["reversal_mean_um"] == pytest.approx(1.0)
    assert found_of([], [[1, 1, 1, 1]]).forward is None


def test_the_standard_asks_for_five_runs_each_way():
    row = [0, 1, 2, 3]
    assert not found_of([row] * 5, [row] * 5).short_of_the_standard
    for forward, backward in ((4, 5), (5, 4), (5, 0), (0, 5)):
        assert found_of([row] * forward, [row] * backward).short_of_the_standard


def test_a_spike_is_further_out_than_so_many_robust_standard_deviations():
    # The median is 0, the median distance 1 µm: 1.4826 µm is one robust standard deviation.
    base = np.array([-1.0, 1.0] * 20)
    for value, spike in ((8.8, False), (9.0, True), (-8.8, False), (-9.0, True)):
        readings = np.append(base, [0.0, value, -value / 100.0]) * 1e-6
        assert spikes(readings, 6.0).tolist() == [False] * 41 + [spike, False]
        # Where the zero lies does not matter.
        assert spikes(readings + 5e-3, 6.0).tolist() == [False] * 41 + [spike, False]


def noisy(count=5, points=40):
    return np.random.default_rng(3).normal(0.0, 3e-8, (count, points))


def test_of_three_runs_one_that_was_knocked_is_rejected_and_of_two_none():
    values = noisy(3)
    values[1, 10:22] += 3e-6
    assert disagreement(values, 6.0).runs.tolist() == [False, True, False]
    found = disagreement(values[:2], 6.0)
    assert not found.runs.any() and not found.points.any()


def test_single_points_are_rejected_up_to_three_neighbours_and_then_the_run():
    for bad, run in ((1, False), (3, False), (4, True)):
        values = noisy()
        values[2, 10 : 10 + bad] += 3e-6
        found = disagreement(values, 6.0)
        assert found.runs.tolist() == [False, False, run, False, False]
        assert np.count_nonzero(found.points) == (0 if run else bad)
    # Two stretches of three are no stretch of six.
    values = noisy()
    values[2, [3, 4, 5, 8, 9, 10]] -= 3e-6
    found = disagreement(values, 6.0)
    assert not found.runs.any() and np.flatnonzero(found.points[2]).tolist() == [3, 4, 5, 8, 9, 10]


def test_a_run_with_more_than_a_quarter_of_bad_points_is_rejected_though_none_are_neighbours():
    for bad, run in ((10, False), (11, True)):
        values = noisy()
        values[0, np.arange(bad) * 3 + 2] += 3e-6
        assert disagreement(values, 6.0).runs.tolist() == [run, False, False, False, False]


def test_the_worst_run_goes_first_and_then_the_others_are_judged_anew():
    values = noisy(7)
    values[3] += 9e-6
    values[5] += 3e-6
    assert disagreement(values, 6.0).runs.tolist() == [False, False, False, True, False, True, False]


LIMIT = 6.0
POINTS = 100
GUIDE = 1e-5 * np.sin(np.linspace(0.0, 6.0, POINTS))


def runs(count: int, noise: float = 50e-9, seed: int = 1) -> NDArray[np.float64]:
    """Runs over a guide that agree within ``noise`` in m."""
    return np.asarray(GUIDE + np.random.default_rng(seed).normal(0.0, noise, (count, POINTS)))


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
