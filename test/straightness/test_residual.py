"""Straightness about a line by its definition; the shipped guide is what it claims to be."""

import runpy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import REPOSITORY
from surveys import GUIDE

from straightcomp_ros.straightness.guide_map import load_map
from straightcomp_ros.straightness.residual import (
    end_point_residual,
    least_squares_residual,
    minimum_zone,
    minimum_zones,
    peak_to_peak,
    rms,
)
from straightcomp_ros.straightness.survey import read_survey

X = np.linspace(-1.0, 1.0, 2001)


def test_a_bow_is_as_high_about_either_line_and_the_end_point_line_goes_through_the_ends():
    assert peak_to_peak(least_squares_residual(X, 5e-6 * X**2)) == pytest.approx(5e-6)
    assert peak_to_peak(end_point_residual(X, 5e-6 * X**2)) == pytest.approx(5e-6)
    assert end_point_residual(X, np.exp(X))[[0, -1]] == pytest.approx(0.0, abs=1e-15)


def test_weighted_least_squares_are_those_of_numpy_and_points_without_weight_count_for_nothing():
    random = np.random.default_rng(4)
    x, values, weights = random.uniform(0.5, 2.0, 30), random.normal(size=30), random.uniform(0.0, 3.0, 30)
    weights[:3] = 0.0
    expected = values - np.polyval(np.polyfit(x, values, 1, w=np.sqrt(weights)), x)
    np.testing.assert_allclose(least_squares_residual(x, values, weights), expected, atol=1e-12)
    assert rms(values) == pytest.approx(np.linalg.norm(values) / np.sqrt(30.0)) and rms(values[:0]) == 0.0


@given(st.lists(st.floats(-1e-4, 1e-4), min_size=3, max_size=50), st.floats(-1e-4, 1e-4), st.floats(-1e-4, 1e-4))
def test_adding_a_line_changes_no_residual_and_least_squares_leave_neither_mean_nor_trend(values, level, slope):
    x, values = np.linspace(0.0, 1.76, len(values)), np.array(values)
    for residual in (least_squares_residual, end_point_residual):
        np.testing.assert_allclose(residual(x, values + level + slope * x), residual(x, values), atol=1e-18)
        np.testing.assert_allclose(residual(x, level + slope * x), 0.0, atol=1e-19)
    left = least_squares_residual(x, values)
    assert abs(left.sum()) < 1e-17 and abs(left @ x) < 1e-17


CONFIG = REPOSITORY / "config"


def test_the_script_makes_the_same_bytes_again(tmp_path):
    runpy.run_path(str(REPOSITORY / "scripts/make_synthetic_survey.py"))["make"](tmp_path)
    for name in ("survey_synthetic.csv", "guide_synthetic.csv"):
        assert (tmp_path / name).read_bytes() == (CONFIG / name).read_bytes()


def test_the_guide_is_22_4_micrometres_peak_to_peak_over_1760_mm_and_as_steep_as_the_papers():
    run = read_survey(CONFIG / "guide_synthetic.csv").runs[0]
    assert (run.x[0], run.x[-1]) == (0.0, 1.76)
    assert peak_to_peak(run.deviation) == pytest.approx(22.4e-6, abs=1e-12)
    assert peak_to_peak(least_squares_residual(run.x, run.deviation)) == pytest.approx(22.4e-6, abs=1e-9)
    slope_um_per_mm = np.abs(GUIDE.evaluate(np.linspace(0.0, 1.76, 17_601))[1]) * 1e3
    assert 0.115 < slope_um_per_mm.max() < 0.125
    assert 0.04 < np.median(slope_um_per_mm) < np.percentile(slope_um_per_mm, 90) < 0.09


def test_the_survey_is_six_runs_that_repeat_within_a_tenth_of_a_micrometre():
    straightness = load_map()
    report = straightness.report
    assert (len(report.x), report.forward.runs, report.backward.runs) == (177, 3, 3)
    s = np.concatenate([report.forward.s, report.backward.s])
    assert s.max() < 0.1e-6 and np.sqrt(np.mean(s**2)) == pytest.approx(0.025e-6, rel=0.1)
    # 177 differences of two means of three: the largest of them lies below four standard deviations.
    assert np.abs(report.reversal).max() < 4.0 * 0.025e-6 * np.sqrt(2.0 / 3.0)
    between = np.linspace(0.0, 1.76, 20_001)
    assert np.ptp(straightness.deviations(between) - GUIDE.deviations(between)) < 0.08e-6


@pytest.mark.parametrize("count", [3, 4, 50])
def test_the_minimum_zone_is_the_narrowest_of_the_zones_with_an_edge_through_two_points(count):
    rng = np.random.default_rng(count)
    for _ in range(20):
        # Some points share their x, the first and the last one too.
        x, y = np.round(rng.uniform(0.0, 1.7, count), 1), rng.normal(0.0, 1e-6, count)
        x[:3] = 0.0, 1.7, 1.7
        rise, run = y[:, None] - y, x[:, None] - x
        slopes = rise[run != 0.0] / run[run != 0.0]
        width = np.ptp(y - slopes[:, None] * x, axis=1).min()
        assert minimum_zone(x, y + 1e-3 * x) == pytest.approx(width, rel=1e-6)
        assert minimum_zone(x, 1e-3 * x) == pytest.approx(0.0, abs=1e-15) and minimum_zone(x, 0.0 * x) == 0.0


def test_the_minimum_zones_of_many_sets_are_those_of_each_with_its_highest_and_its_lowest_points():
    rng = np.random.default_rng(0)
    x, middle = np.linspace(0.3, 1.7, 60), rng.normal(0.0, 1e-6, (200, 60)).cumsum(axis=1)
    apart = np.abs(rng.normal(0.0, 1e-6, middle.shape))
    found = minimum_zones(rng.normal(0.0, 1e-6, 200), x, middle + apart, middle - apart)
    for one, curve, half in zip(found, middle, apart, strict=True):
        assert one == pytest.approx(minimum_zone(np.tile(x, 2), np.concatenate([curve + half, curve - half])), rel=1e-9)
