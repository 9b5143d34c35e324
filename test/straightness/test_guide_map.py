"""The map: exact for a cubic guide, smooth everywhere; within the travel."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from surveys import one_run

from straightcomp_ros.straightness.guide_map import (
    MapParameters,
    StraightnessMap,
    find_survey,
    load_map,
    runout,
)
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.straightness.survey_header import SurveyError

X = np.linspace(0.0, 1.76, 177)


def _map(deviation, x=X, **parameters):
    return StraightnessMap(one_run(x, deviation), MapParameters(**parameters))


def wavy():
    return _map(1e-5 * np.sin(4.0 * X + 0.3) + 1e-6 * np.cos(25.0 * X))


maps = st.lists(st.floats(-1e-5, 1e-5), min_size=20, max_size=40).map(
    lambda values: _map(np.array(values), np.linspace(0.0, 0.5, len(values)), travel=1e-2)
)


def test_a_cubic_guide_is_reproduced_exactly_and_the_reference_is_centred():
    def cubic(x):
        return 1e-5 * (x**3 - 2.0 * x**2 + 0.5 * x)

    straightness = _map(cubic(X))
    between = np.linspace(0.0, 1.76, 1234)
    r, slope, curvature = straightness.evaluate(between)
    np.testing.assert_allclose(straightness.deviations(between), cubic(between), atol=1e-18)
    np.testing.assert_allclose(r, straightness.offset - cubic(between), atol=1e-18)
    np.testing.assert_allclose(slope, -1e-5 * (3.0 * between**2 - 4.0 * between + 0.5), atol=1e-16)
    np.testing.assert_allclose(curvature, -1e-5 * (6.0 * between - 4.0), atol=1e-13)
    r = wavy().evaluate(np.linspace(0.0, 1.76, 100_001))[0]
    assert r.max() == pytest.approx(-r.min(), abs=1e-13)  # the reference is centred


def test_scalar_and_array_evaluation_agree_to_the_last_bit_at_the_joints_too():
    straightness = wavy()
    anywhere = np.random.default_rng(1).uniform(-0.5, 2.5, 200)
    x = np.concatenate([X, np.nextafter(X, -9.0), np.nextafter(X, 9.0), [-0.02, 1.78, -9.0, 9.0], anywhere])
    np.testing.assert_array_equal(
        np.array(straightness.evaluate(x)).T, [straightness.reference(at) for at in x.tolist()]
    )
    offset = straightness.offset
    np.testing.assert_array_equal(straightness.deviations(x), [offset - straightness.reference(at)[0] for at in x])
    for far, near in ((-9.0, -0.02), (9.0, 1.78)):
        assert straightness.reference(far) == (straightness.reference(near)[0], 0.0, 0.0)


def test_the_steepest_place_of_a_map_may_lie_between_its_points():
    straightness = _map(1e-7 * (-1.0) ** np.arange(X.size))
    slopes = straightness.evaluate(np.linspace(0.0, 1.76, 17_601))[1]
    assert straightness.steepest == pytest.approx(np.abs(slopes).max(), rel=1e-3)


def test_a_map_is_centred_by_the_turning_points_of_the_survey_alone():
    # The parabola turns beyond the survey's end.
    straightness = _map(1e-5 * (X - 1.9) ** 2)
    assert straightness.offset == pytest.approx(0.5e-5 * (1.9**2 + 0.14**2))


def test_references_of_the_encoder_that_differ_are_a_mismatch_and_an_unknown_one_is_none():
    survey = one_run(X, 1e-5 * np.sin(X))
    for mark, described, wrong in (("a", "b", True), ("a", "a", False), ("a", "", False), ("", "a", False)):
        marked = replace(survey, facts={"encoder reference": mark} if mark else {})
        straightness = StraightnessMap(marked, MapParameters(reference=described))
        assert bool(straightness.mismatch()) == wrong
        assert straightness.mismatch() in str(straightness) and not str(straightness).endswith("; ")


@settings(max_examples=50, deadline=None)
@given(straightness=maps, x=st.floats(-0.1, 0.6))
def test_the_derivatives_are_those_of_the_reference(straightness, x):
    h = 1e-6
    (before, slope_before, _), (_, slope, curvature), (after, slope_after, _) = (
        straightness.reference(x + step) for step in (-h, 0.0, h)
    )
    # Curvature is continuous, its slope bounded: within 2h it changes by what two samples of it differ.
    change = max(abs(straightness.reference(x + step)[2] - curvature) for step in (-h, h))
    assert (after - before) / (2.0 * h) == pytest.approx(slope, abs=h * change + 1e-14)
    assert (slope_after - slope_before) / (2.0 * h) == pytest.approx(curvature, abs=2.0 * change + 1e-9)


@settings(max_examples=50, deadline=None)
@given(straightness=maps)
def test_value_slope_and_curvature_are_continuous_at_every_joint(straightness):
    low, high = straightness.span
    for joint in (low - 0.02, low, 0.25, high, high + 0.02):
        left = straightness.reference(math.nextafter(joint, -9.0))
        right = straightness.reference(joint)
        # Rounding of the polynomials at the far end of a piece, slope and curvature up to 1e-1 and 1e2 here.
        for a, b, grain in zip(left, right, (1e-17, 1e-14, 1e-11), strict=True):
            assert a == pytest.approx(b, abs=grain, rel=1e-9)


@settings(max_examples=100, deadline=None)
@given(values=st.lists(st.floats(-1e-4, 1e-4), min_size=20, max_size=40), travel=st.floats(1e-6, 2e-4))
def test_a_map_is_refused_exactly_where_its_reference_would_exceed_the_travel(values, travel):
    x, fine = np.linspace(0.0, 0.5, len(values)), np.linspace(-0.05, 0.55, 6001)
    largest = np.abs(_map(np.array(values), x, travel=1e-2).evaluate(fine)[0]).max()
    try:
        _map(np.array(values), x, travel=travel)
    except SurveyError as error:
        # The largest value may lie between two of the fine points.
        assert largest > 0.999 * travel and "allowed: <=" in str(error)
    else:
        assert largest <= travel * (1.0 + 1e-12)


def test_a_map_is_made_once_for_a_file_and_anew_when_the_file_has_changed(tmp_path):
    parameters = MapParameters(file=str(tmp_path / "survey.csv"), smooth="none")
    maps = []
    for height in (1e-6, 1e-6, 2e-6):
        deviation = height * np.sin(7.0 * X)
        write_survey(parameters.file, one_run(X, deviation))
        maps.append(load_map(parameters))
    assert maps[0] is maps[1] and maps[2].deviations(0.2) == pytest.approx(2.0 * maps[0].deviations(0.2), abs=2e-9)
    assert load_map(replace(parameters, smooth="auto")) is not maps[2]


def test_a_relative_name_is_looked_up_in_the_working_directory_first(tmp_path, monkeypatch):
    (tmp_path / "config").mkdir()
    write_survey(tmp_path / "config/survey_synthetic.csv", one_run(X, 1e-5 * np.sin(X)))
    assert load_map().report.forward.runs == 3
    monkeypatch.chdir(tmp_path)
    assert load_map().report.forward.runs == 1
    for name, words in (("config/no_such_survey.csv", "working directory"), ("/none.csv", "there is no such file")):
        with pytest.raises(SurveyError, match=words):
            find_survey(name)
    with pytest.raises(SurveyError, match="is no file"):
        find_survey("config")


@given(
    value=st.floats(-1e-4, 1e-4),
    slope=st.floats(-1e-3, 1e-3),
    curvature=st.floats(-1e-1, 1e-1),
    length=st.floats(1e-3, 0.5),
)
def test_no_value_on_the_way_lies_outside_of_start_turning_and_held(value, slope, curvature, length):
    coefficients, held, turning = runout(value, slope, curvature, length)
    curve = Polynomial(coefficients)
    ends = [[curve.deriv(order)(at) if order else curve(at) for order in range(3)] for at in (0.0, length)]
    # Numbers below 1e-308 have fewer digits: a floor of no size at all.
    size = abs(value) + abs(slope) * length + abs(curvature) * length**2 + 1e-18
    for found, expected in zip(ends, ((value, slope, curvature), (held, 0.0, 0.0)), strict=True):
        assert found == pytest.approx(expected, abs=1e-9 * size / length**2)
    path = curve(np.linspace(0.0, length, 201))
    assert path.max() <= max(value, turning, held) + 1e-12 * size
    assert path.min() >= min(value, turning, held) - 1e-12 * size
