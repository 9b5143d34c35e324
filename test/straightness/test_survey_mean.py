"""The mean over the runs and the figures of their agreement."""

import numpy as np
import pytest
from numpy.typing import NDArray
from straightcomp_ros.straightness.survey_runs import Directed, Repeatability, on_common_grid, repeatability

from straightcomp_ros.straightness.survey import Direction, Run, Survey, SurveyError

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


def test_repeatability_and_hysteresis_are_those_of_their_definition() -> None:
    # Two runs 2d apart: sample standard deviation d √2.
    x, values, survey = _grid(
        _run("forward", -1e-8), _run("forward", 1e-8), _run("backward", 3e-8), _run("backward", 9e-8)
    )
    found = repeatability(survey, x, values)
    assert found.forward is not None and found.backward is not None
    assert (found.forward.runs, found.backward.runs, len(found.x)) == (2, 2, 101)
    np.testing.assert_allclose(found.forward.s, 1e-8 * np.sqrt(2.0))
    np.testing.assert_allclose(found.backward.s, 3e-8 * np.sqrt(2.0))
    np.testing.assert_allclose(found.reversal, -6e-8)
    assert np.ptp(found.mean) == pytest.approx(np.ptp(_bow(X)))
    assert str(found) == (
        "101 points, 2 forward and 2 backward runs, 10.00 µm peak to peak, standard deviation at most 0.042 µm, "
        "hysteresis 0.060 µm"
    )


def test_one_run_has_neither_repeatability_nor_hysteresis() -> None:
    x, values, survey = _grid(_run("forward"))
    found = repeatability(survey, x, values)
    assert found.forward is not None and found.forward.s is found.reversal is None
    assert str(found) == "101 points, 1 forward and 0 backward runs, 10.00 µm peak to peak"
    assert found.to_display()["reversal_max_um"] is None


def test_a_report_reads_as_text_with_the_largest_figure_of_either_direction() -> None:
    mean = np.array([0.0, 22.4e-6])
    forward, backward = Directed(3, mean, np.array([1e-8, 6e-8])), Directed(3, mean - 7e-8, np.array([5e-8, 2e-8]))
    for both in ((forward, backward), (backward, forward)):
        text = str(Repeatability(np.array([0.0, 0.1]), *both))
        assert text.endswith("22.40 µm peak to peak, standard deviation at most 0.060 µm, hysteresis 0.070 µm")


def test_a_run_that_was_broken_off_is_refused() -> None:
    with pytest.raises(SurveyError, match=r"runs end between x = 500 mm and 1000 mm.*within 50 mm.*broken off"):
        _grid(_run("forward"), _run("backward", x=np.linspace(0.0, 0.5, 51)))


def test_too_few_common_points_are_refused() -> None:
    with pytest.raises(SurveyError, match="11 points in the range that all runs cover; allowed: >= 20"):
        _grid(_run("forward", x=np.linspace(0.0, 1.0, 11)))


def test_a_survey_without_a_run_is_refused() -> None:
    with pytest.raises(SurveyError, match="no run"):
        _grid()
