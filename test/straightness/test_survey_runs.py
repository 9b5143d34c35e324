"""The runs of a survey together: on one grid; their repeatability by its definition."""

import math

import numpy as np
import pytest

from straightcomp_ros.straightness.survey import Run, Survey, SurveyError
from straightcomp_ros.straightness.survey_runs import on_common_grid, repeatability

X = np.linspace(0.0, 1.0, 101)


def _bow(x):
    return 1e-5 * np.sin(3.0 * x)


def _run(direction, offset=0.0, x=X):
    return Run("1", direction, x, _bow(x) + offset)


def _grid(*runs):
    survey = Survey(runs)
    return *on_common_grid(survey, min_points=20, max_gap=0.05), survey


def test_runs_on_the_same_x_are_taken_as_measured_and_others_brought_onto_the_first_ones_grid():
    x, values, _ = _grid(_run("forward"), _run("backward", 1e-7), _run("backward", x=np.linspace(0.0, 1.0, 83)))
    np.testing.assert_array_equal(x, X)
    np.testing.assert_array_equal(values[:2], [_bow(X), _bow(X) + 1e-7])
    np.testing.assert_allclose(values[2], _bow(X), atol=1e-12)


def test_the_grid_keeps_to_what_all_runs_cover():
    x, values, _ = _grid(_run("forward"), _run("backward", x=np.linspace(0.0012, 0.9988, 101)))
    assert (x[0], x[-1]) == (0.0012, 0.9988)
    assert np.diff(x).min() > 0.005
    np.testing.assert_allclose(values[0], _bow(x), atol=1e-12)


def test_directions_weigh_the_same_whatever_the_number_of_their_runs():
    x, values, survey = _grid(_run("forward", 0.0), _run("forward", 0.0), _run("forward", 0.0), _run("backward", 4e-8))
    np.testing.assert_allclose(repeatability(survey, x, values).mean, _bow(X) + 2e-8, rtol=1e-12)


@pytest.mark.parametrize(
    ("runs", "words"),
    [
        ([_run("forward"), _run("backward", x=X[:51])], "between x = 500 mm and 1000 mm.*within 50 mm.*broken off"),
        ([_run("forward", x=np.linspace(0.0, 1.0, 11))], "11 points in the range that all runs cover; allowed: >= 20"),
        ([], "no run"),
    ],
)
def test_runs_without_a_common_grid_are_refused(runs, words):
    with pytest.raises(SurveyError, match=words):
        _grid(*runs)


FOUR = np.arange(4) * 0.01


def found_of(forward, backward):
    """Repeatability of runs given as rows of deviations in µm at four points."""
    rows = [("forward", row) for row in forward] + [("backward", row) for row in backward]
    runs = tuple(Run(str(i), way, FOUR, np.array(row) * 1e-6) for i, (way, row) in enumerate(rows))
    return repeatability(Survey(runs), FOUR, np.array([run.deviation for run in runs]))


def test_the_figures_are_those_of_the_standard_at_the_worst_point():
    found = found_of([[1, 0, 0, 0], [3, 0, 0, 0]], [[0, 0, 0, 5], [0, 0, 0, 9]])
    # s: √2 and 2√2 µm, which the bidirectional figure adds to the reversal.
    assert found.to_display() == pytest.approx(
        {
            "repeatability_forward_um": 4.0 * math.sqrt(2.0),
            "repeatability_backward_um": 8.0 * math.sqrt(2.0),
            "repeatability_bidirectional_um": 4.0 * math.sqrt(2.0) + 7.0,
            "reversal_max_um": 7.0,
            "reversal_mean_um": -1.25,
        }
    )
    assert found.reversal == pytest.approx([2e-6, 0.0, 0.0, -7e-6])


@pytest.mark.parametrize(
    "forward, backward, um",
    [((1, 3), (0, 4), 8.0 * math.sqrt(2.0)), ((0, 4), (2, 2), 8.0 * math.sqrt(2.0)), ((11, 13), (0, 4), None)],
)
def test_the_bidirectional_figure_is_that_of_the_worse_direction_or_of_both_and_the_reversal(forward, backward, um):
    found = found_of(*([[value, 0, 0, 0] for value in values] for values in (forward, backward)))
    # s: √2 and 2√2 µm.
    assert found.bidirectional == pytest.approx((um or 6.0 * math.sqrt(2.0) + 10.0) * 1e-6)


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
