"""A guide that is another one on the way back: two tables where it shows, no step of the reference between them."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.legendre import Legendre
from recorded_run import recorded_run
from scipy.stats import f, linregress

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.straightness.feedforward import (
    Feedforward,
    Travel,
    along,
    follower,
    handover,
    outdated_handover,
    rates,
)
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.hysteresis import half_difference
from straightcomp_ros.straightness.smoothing import MapNoise
from straightcomp_ros.straightness.survey import Run, Survey, write_survey
from straightcomp_ros.straightness.survey_header import SurveyError
from trials.noise import FINE, WAYS, Kind, guide, mapped, surveyed

HYSTERESIS = 0.3e-6
KIND = Kind(hysteresis=HYSTERESIS)
SURVEY = surveyed(10e-3, 25e-9, KIND)
MAP = mapped(SURVEY)
LEVEL = mapped(Survey(tuple(replace(run, deviation=run.deviation - guide(run.x)) for run in SURVEY.runs)))
"""Of the hysteresis alone."""
PERIOD_NS = 500_000


X = np.linspace(0.2, 1.4, 61)


def half_of(ways, values, noise=0.0):
    """h of runs of these ways (1 forward, -1 backward) whose noise of a point is known, at X; None without any."""
    survey = Survey(tuple(Run("1", WAYS[int(way < 0)], X, run) for way, run in zip(ways, values, strict=True)))
    means = [np.mean([run for way, run in zip(ways, values, strict=True) if way == one], axis=0) for one in (1, -1)]
    known = MapNoise(noise, len(ways), True, False, X, 0.0 * X, 0.0)
    found = half_difference(survey, X, np.array(values), np.mean(means, axis=0), known, "auto", False)
    return found and found[0](X)


def test_level_and_tilt_count_where_their_regression_on_the_direction_is_significant():
    random, counted = np.random.default_rng(2), []
    middle = (X - X.mean()) / np.ptp(X)
    for ways in ([1, 1, -1], [1, 1, -1, -1], [1, -1, 1, -1, 1, -1, -1], [1, 1, 1, 1, -1, -1, -1, -1]):
        for spread in np.geomspace(1e-4, 1.0, 6) * 1e-6:
            lines = 1e-6 * random.normal(size=2) * np.array(ways)[:, None] + spread * random.normal(size=(len(ways), 2))
            found = half_of(ways, lines @ [np.ones_like(X), middle], 1e-3)
            of = [linregress(ways, column) for column in lines.T]
            kept = [one.slope if one.pvalue < 1e-3 else 0.0 for one in of]
            expected = kept[0] + kept[1] * middle
            np.testing.assert_allclose(0.0 * X if found is None else found, expected, rtol=0, atol=1e-15)
            counted += map(bool, kept)
    assert 0.2 < np.mean(counted) < 0.8


@pytest.mark.parametrize("ways", [[1, 1, -1], [1, -1, 1, -1, 1, -1]])
@pytest.mark.parametrize("degree", [None, 2, 5, 9, 10])
def test_a_shape_counts_where_its_f_ratio_to_the_noise_is_significant_at_all_points_or_in_slow_waves(ways, degree):
    all_points, waves = X.size - 2, 8
    shape = (-1.0) ** np.arange(X.size) if degree is None else Legendre.basis(degree, X[[0, -1]])(X)
    shape -= np.polyval(np.polyfit(X, shape, 1), X)
    slow = degree is not None and degree <= 9
    count = waves if slow else all_points
    least = 1e-7 * math.sqrt(f.isf(5e-4, count, (len(ways) - 2) * all_points) * count / (shape @ shape))
    # A polynomial that is orthogonal over the line is nearly so over its points.
    near = 0.01 if degree is None or slow else 0.2
    for factor, counts in ((1.0 - near, False), (1.0 + near, True)):
        values = [way * factor * least * shape for way in ways]
        assert (half_of(ways, values, 1e-7) is not None) == counts


def test_what_the_rounding_of_a_file_makes_of_equal_runs_is_no_hysteresis():
    ways, middle = [1, 1, -1, -1], (X - X.mean()) / np.ptp(X)
    for shape in (np.ones_like(X), middle, np.cos(20.0 * X)):
        for size, counts in ((0.2e-9, False), (1e-9, True)):
            assert (half_of(ways, [way * size * shape for way in ways]) is not None) == counts


@pytest.mark.parametrize("noise", [25e-9, 2e-7])
@pytest.mark.parametrize("spacing", [1e-3, 10e-3])
def test_hysteresis_that_is_more_than_the_noise_makes_a_table_for_each_direction(spacing, noise):
    straightness = mapped(surveyed(spacing, noise, KIND))
    assert straightness.directed and "two tables" in str(straightness)
    for way in WAYS:
        errors = [np.std(straightness.deviations(FINE, of) - KIND.true(FINE, way)) for of in (way, None)]
        assert errors[0] < 0.9 * errors[1]


def test_noise_and_drift_of_the_instrument_are_no_hysteresis_and_leave_the_map_as_it_was_to_the_last_bit():
    found = 0
    for seed in range(40):
        survey = surveyed(20e-3, 1e-7, seed=1000 + seed, drift=1e-7 * (seed % 2))
        straightness = mapped(survey)
        found += straightness.directed
        if not straightness.directed:
            plain = StraightnessMap(survey, MapParameters(travel=5e-3, direction="mean"))
            np.testing.assert_array_equal(straightness.evaluate(FINE), plain.evaluate(FINE))
            assert follower(straightness) == straightness.reference
    assert found <= 1


def test_the_noise_of_a_run_with_ten_times_the_points_is_no_hysteresis():
    coarse, fine = surveyed(20e-3, 1e-7), surveyed(2e-3, 1e-7)
    for place in (0, 3):
        runs = [*coarse.runs[:place], fine.runs[place], *coarse.runs[place + 1 :]]
        straightness = mapped(Survey(tuple(runs)))
        assert not straightness.directed
        assert straightness.noise.point == pytest.approx(mapped(coarse).noise.point, rel=0.1)


def test_the_noise_of_runs_that_share_few_points_is_that_of_these_points_and_any_order_gives_the_finer_ones():
    coarse, fine = (surveyed(step, 1e-7).runs for step in (20e-3, 2e-3))
    for runs in ([coarse[0], fine[2]], [fine[2], coarse[0]]):
        assert runs[0].direction == runs[1].direction
        straightness = mapped(Survey(tuple(runs)))
        assert len(straightness.report.x) == len(fine[0].x)
        assert straightness.noise.point == pytest.approx(1e-7 / math.sqrt(2.0), rel=0.25)


def test_only_what_was_repeated_both_ways_shows_hysteresis():
    for runs in (SURVEY.runs[:2], SURVEY.runs[::2]):
        survey = Survey(runs)
        assert not mapped(survey).directed
        both = StraightnessMap(survey, MapParameters(travel=5e-3, direction="both"))
        assert both.directed == (runs[0].direction != runs[1].direction)


def test_two_tables_that_leave_the_travel_inside_the_survey_are_not_refused_for_the_run_out():
    survey = surveyed(10e-3, 25e-9, Kind(hysteresis=3e-6))
    straightness = mapped(survey)
    mean, forward = (np.abs(straightness.evaluate(FINE, way)[0]).max() for way in (None, "forward"))
    with pytest.raises(SurveyError, match="to each side; allowed"):
        StraightnessMap(survey, MapParameters(travel=float(mean + forward) / 2.0))


def test_the_hand_over_leaves_no_step_in_the_reference_its_rate_and_its_acceleration():
    # Reversals at rest, beyond the hand-over and in the middle of it, the last by an acceleration that does not stop.
    assert LEVEL.directed
    time = np.arange(0.0, 2.0, 5e-5)
    x = 0.75 + 0.01 * np.cos(2.0 * np.pi * time) ** 3 + 0.0004 * np.cos(9.0 * time)
    speed, acceleration = np.gradient(x, time), np.gradient(np.gradient(x, time), time)
    r, slope, curvature = along(LEVEL, x)
    rate, second = slope * speed, curvature * speed**2 + slope * acceleration
    assert np.ptp(r) > 0.9 * HYSTERESIS
    # What the derivatives of a function without steps allow from one sample to the next.
    inside = slice(5, -5)
    np.testing.assert_allclose(np.gradient(r, time)[inside], rate[inside], atol=0.01 * np.abs(rate).max())
    np.testing.assert_allclose(np.gradient(rate, time)[inside], second[inside], atol=0.01 * np.abs(second).max())
    assert np.abs(np.diff(second))[inside].max() < 0.03 * np.abs(second).max()


def test_a_stage_at_rest_and_an_encoder_that_toggles_change_no_table():
    travel = Travel(MAP)
    for x in np.linspace(0.7, 0.75, 500):
        travel(x)
    standing = travel(0.75)[0]
    assert standing == pytest.approx(MAP.evaluate(0.75, "forward")[0], abs=1e-15)
    toggled = [travel(0.75 - 1e-7 * (k % 2))[0] for k in range(1000)]
    assert np.ptp(toggled) < 2e-11
    assert np.isnan(travel(float("nan"))[0]) and travel(0.75)[0] == standing


def test_the_tables_are_the_maps_by_direction_with_their_distance_and_their_steepest_place_and_begin_in_the_middle():
    for x in (0.3, 0.7512, -0.01, 1.77, 3.0):
        expected = [tuple(map(float, MAP.evaluate(x, way))) for way in WAYS]
        assert list(MAP.tables(x)) == expected
        assert Travel(MAP)(x)[0] == pytest.approx(MAP.reference(x)[0], abs=1e-18)
    forward, backward = (MAP.evaluate(FINE, way) for way in WAYS)
    assert MAP.hysteresis == pytest.approx(np.abs(forward[0] - backward[0]).max(), rel=0.01)
    assert MAP.steepest == pytest.approx(np.abs([forward[1], backward[1]]).max(), rel=0.01)
    written = np.genfromtxt(MAP.table().splitlines(), delimiter=",", names=True)
    x = SURVEY.runs[0].x
    columns = {"x_mm": x * 1e3, "r_um": MAP.evaluate(x)[0] * 1e6, "s_um": MAP.noise.band(x) * 1e6}
    columns |= {f"r_{way}_um": MAP.evaluate(x, way)[0] * 1e6 for way in WAYS}
    assert written.dtype.names == tuple(columns)
    for name, values in columns.items():
        np.testing.assert_allclose(written[name], values, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("lead", [2e-3, 0.02])
def test_a_reference_from_before_a_reversal_errs_by_as_much_as_is_said(lead):
    acceleration, step, ahead = 0.4, 1e-4, round(lead / 1e-4)
    t = np.arange(0.0, 0.15, step)
    way = 0.5 * acceleration * t**2
    r, slope, curvature = (of[500:] for of in along(LEVEL, 0.75 - np.concatenate([np.linspace(0.1, 0.0, 500), way])))
    rate, second = rates(slope, curvature, -acceleration * t, np.full_like(t, -acceleration))
    error = np.abs(r[ahead:] - (r + rate * lead + second * lead**2 / 2.0)[:-ahead]).max()
    apart = np.abs(np.subtract(*(LEVEL.evaluate(0.75, way)[0] for way in WAYS)))
    assert error == pytest.approx(outdated_handover(apart, acceleration, LEVEL.reversal, lead), rel=0.05)


def test_after_a_whole_hand_over_the_reference_is_that_of_the_other_direction_with_no_more_than_its_bound():
    parameters = MapParameters(travel=5e-3)
    turn = Trajectory([Waypoint(0, 0.7, 0.0), Waypoint(400_000_000, 0.72, 0.0), Waypoint(800_000_000, 0.7, 0.0)])
    stamps = range(0, turn.end_ns, PERIOD_NS)
    x = np.array([turn.position(stamp) for stamp in stamps])

    def answers_of(straightness):
        return np.array(list(map(Feedforward(straightness).step, stamps, x.tolist())))

    answers = answers_of(MAP)
    back = len(x) // 2 + np.flatnonzero(x[len(x) // 2 :] < 0.72 - parameters.reversal)
    np.testing.assert_allclose(answers[back, 0], MAP.evaluate(x[back], "backward")[0], rtol=0, atol=1e-15)
    acceleration = np.abs(np.diff(x, 2)).max() / (PERIOD_NS * 1e-9) ** 2
    rate, second = handover(HYSTERESIS, acceleration, parameters.reversal)
    added = np.abs(answers - answers_of(StraightnessMap(SURVEY, replace(parameters, direction="mean"))))
    assert 0.7 < added[:, 1].max() / rate < 1.2 and 0.7 < added[:, 2].max() / second < 1.2


@pytest.fixture
def values(tmp_path):
    """Of a short stroke over a guide with hysteresis, whose survey is known."""
    write_survey(tmp_path / "survey.csv", SURVEY)
    x = SURVEY.runs[0].x
    truth = tuple(replace(SURVEY.runs[0], direction=way, deviation=KIND.true(x, way)) for way in WAYS)
    write_survey(tmp_path / "truth.csv", Survey(truth))
    values = shipped_parameters()
    motion = {"start": 0.6, "stroke": 0.1, "settle": 0.2, "pause": 0.1}
    values["stage"] |= {f"motion.{name}": value for name, value in motion.items()}
    values["stage"]["guide.file"] = str(tmp_path / "survey.csv")
    values["driver"] |= {"simulated.truth.guide": str(tmp_path / "truth.csv")}
    return values


def test_offline_and_live_code_follow_the_tables_to_the_same_bit_and_beat_their_mean(values):
    record, straightness = run_stroke(by_node(values))
    other = Simulation(by_node(values)).run()
    for name, column in other.columns().items():
        np.testing.assert_array_equal(record.columns()[name], column, err_msg=name)
    values["stage"]["guide.direction"] = "mean"
    of_mean = evaluate(*run_stroke(by_node(values)))
    figures = evaluate(record, straightness)
    assert figures.true_pp_forward < 1.2 * of_mean.true_pp_forward
    assert figures.residual_pp < of_mean.residual_pp - 0.3 * HYSTERESIS


def test_a_bag_of_two_tables_is_evaluated_as_the_run_that_it_recorded(values, tmp_path):
    evaluation = evaluate_bag(recorded_run(tmp_path / "bag", by_node(values)))
    assert evaluation.map is not None and evaluation.map.directed and evaluation.record.reference.directed

    def known(figures):
        return {name: figure for name, figure in figures.to_display().items() if figure is not None}

    rows = list(csv.DictReader(read_attachments(tmp_path / "bag")["map_band.csv"].decode().splitlines()))
    for name, of in (("s", MAP.noise.band), ("r_forward", lambda x: MAP.evaluate(x, "forward")[0])):
        found = [float(row[f"{name}_um"]) * 1e-6 for row in rows]
        np.testing.assert_allclose(found, of(SURVEY.runs[0].x), atol=2e-9)
    expected = evaluate(*run_stroke(by_node(values)))
    for reference in (evaluation.map, evaluation.record.reference):
        assert known(evaluate(evaluation.record, reference)) == pytest.approx(known(expected), rel=1e-6)


def test_linuxcnc_gets_both_tables_and_a_controller_with_one_their_mean_and_a_word(values, tmp_path, verb):
    for name, ways in (("table.comp", 2), ("table.cal", 1)):
        export = ["map", "export", "--survey", values["stage"]["guide.file"], "-o", tmp_path / name]
        assert verb(*export, "--json").json["directions"] == ways
        assert ("one table for both directions" in verb(*export, "--force").err) == (ways == 1)
    rows = np.loadtxt(tmp_path / "table.comp")
    for column, way in ((1, "forward"), (2, "backward")):
        np.testing.assert_allclose(rows[:, column] * 1e-3, MAP.evaluate(rows[:, 0] * 1e-3, way)[0], atol=1e-9)
