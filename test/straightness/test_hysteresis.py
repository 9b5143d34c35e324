"""A guide that is another one on the way back: two tables where it shows, no step of the reference between them."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.model.motion import Trajectory, Waypoint
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.straightness.feedforward import Feedforward, Travel, along, follower, handover
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.survey import Survey, write_survey
from straightcomp_ros.straightness.survey_table import SurveyError
from trials.noise import FINE, WAYS, Kind, guide, mapped, surveyed

HYSTERESIS = 0.3e-6
KIND = Kind(hysteresis=HYSTERESIS)
SURVEY = surveyed(10e-3, 25e-9, KIND)
MAP = mapped(SURVEY)
PERIOD_NS = 500_000


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
    level = mapped(replace(SURVEY, runs=tuple(replace(r, deviation=r.deviation - guide(r.x)) for r in SURVEY.runs)))
    assert level.directed
    time = np.arange(0.0, 2.0, 5e-5)
    x = 0.75 + 0.01 * np.cos(2.0 * np.pi * time) ** 3 + 0.0004 * np.cos(9.0 * time)
    speed, acceleration = np.gradient(x, time), np.gradient(np.gradient(x, time), time)
    r, slope, curvature = along(level, x)
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
    assert added[:, 1].max() < 1.2 * rate and added[:, 2].max() < 1.2 * second


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
    simulation = Simulation(by_node(values))
    with SimulatedRun(tmp_path / "bag", by_node(values), simulation.delay) as bag:
        record = simulation.run(observe=bag.add)
    evaluation = evaluate_bag(tmp_path / "bag")
    assert evaluation.map is not None and evaluation.map.directed and evaluation.record.reference.directed

    def known(figures):
        return {name: figure for name, figure in figures.to_display().items() if figure is not None}

    rows = list(csv.DictReader(read_attachments(tmp_path / "bag")["map_band.csv"].decode().splitlines()))
    for name, values in (("s", MAP.noise.band), ("r_forward", lambda x: MAP.evaluate(x, "forward")[0])):
        found = [float(row[f"{name}_um"]) * 1e-6 for row in rows]
        np.testing.assert_allclose(found, values(SURVEY.runs[0].x), atol=2e-9)
    expected = evaluate(record, simulation.map)
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
