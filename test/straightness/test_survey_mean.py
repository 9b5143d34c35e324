"""The mean over the runs and the figures of their agreement."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from straightcomp_ros.straightness.mean import SurveyReport, mean_of_directions, on_common_grid, report
from straightcomp_ros.straightness.survey import Survey, SurveyError
from straightcomp_ros.straightness.survey_run import Direction, Run

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
    _, values, survey = _grid(_run("forward", 0.0), _run("forward", 0.0), _run("forward", 0.0), _run("backward", 4e-8))
    np.testing.assert_allclose(mean_of_directions(survey, values), _bow(X) + 2e-8, rtol=1e-12)


def test_repeatability_and_hysteresis_are_those_of_their_definition() -> None:
    # Two runs 2d apart: sample standard deviation d √2.
    _, values, survey = _grid(
        _run("forward", -1e-8), _run("forward", 1e-8), _run("backward", 3e-8), _run("backward", 9e-8)
    )
    figures = report(survey, values)
    assert (figures.forward_runs, figures.backward_runs, figures.points) == (2, 2, 101)
    assert figures.repeatability_max == pytest.approx(3e-8 * np.sqrt(2.0))
    assert figures.repeatability_rms == pytest.approx(np.sqrt(np.mean([2e-16, 18e-16])))
    assert figures.hysteresis == pytest.approx(6e-8)
    assert figures.peak_to_peak == pytest.approx(np.ptp(_bow(X)))


def test_one_run_has_neither_repeatability_nor_hysteresis() -> None:
    _, values, survey = _grid(_run("forward"))
    figures = report(survey, values)
    assert figures.repeatability_max is figures.repeatability_rms is figures.hysteresis is None
    assert str(figures) == "101 points, 1 forward and 0 backward runs, 10.00 µm peak to peak"
    assert figures.to_display()["hysteresis_um"] is None


def test_a_report_reads_as_text_and_in_micrometres() -> None:
    figures = SurveyReport(177, 3, 3, 22.4e-6, 6e-8, 2.5e-8, 7e-8)
    assert str(figures).endswith("22.40 µm peak to peak, standard deviation at most 0.060 µm, hysteresis 0.070 µm")
    assert figures.to_display()["peak_to_peak_um"] == pytest.approx(22.4)


def test_a_run_that_was_broken_off_is_refused() -> None:
    with pytest.raises(SurveyError, match=r"runs end between x = 500 mm and 1000 mm.*within 50 mm.*broken off"):
        _grid(_run("forward"), _run("backward", x=np.linspace(0.0, 0.5, 51)))


def test_too_few_common_points_are_refused() -> None:
    with pytest.raises(SurveyError, match="11 points in the range that all runs cover; allowed: >= 20"):
        _grid(_run("forward", x=np.linspace(0.0, 1.0, 11)))


def test_a_survey_without_a_run_is_refused() -> None:
    with pytest.raises(SurveyError, match="no run"):
        _grid()
