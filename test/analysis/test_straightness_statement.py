"""The uncertainty of a straightness holds what it claims, and its budget names what it is made of."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from surveys import one_run
from tiers import nightly

from straightcomp_ros.analysis import straightness_statement as statement
from straightcomp_ros.analysis.metrics import LINES, about_lines
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.straightness_statement import Input, budget_rows, map_input, stated, statements
from straightcomp_ros.fleet.history.strokes_of_bag import rows_of
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.survey_header import WAYS
from straightcomp_ros.straightness.survey_runs import cubic_spline

X = np.linspace(0.0, 1.76, 4000)
POINTS = np.linspace(0.0, 1.76, 60)
SHAPE = 0.3e-6 * np.sin(2.0 * np.pi * 1.3 * X / 1.76) + 0.1e-6 * np.cos(2.0 * np.pi * 4.0 * X / 1.76)
GUIDE = 10e-6 * np.sin(2.0 * np.pi * 3.1 * X / 1.76)
COUNT, NOISE, SPREAD, STROKES, CORRELATION = 0.1e-6, 0.03e-6, 0.05, 8, 0.85


def moving(random, motion, strokes):
    """The platform's ``motion`` in m as that of a servo, an autoregression."""
    steps = random.normal(0.0, motion * math.sqrt(1.0 - CORRELATION**2), (strokes, X.size))
    return lfilter([1.0], [1.0, -CORRELATION], steps, axis=1)


def measured(random, seen, errors, motion=0.0):
    """Statements about strokes that differ in height and by the platform's ``motion`` in m, by an encoder and a map or
    sensor with these errors at their points."""
    curves = (1.0 + SPREAD * random.normal(size=(STROKES, 1))) * SHAPE
    if motion:
        curves += moving(random, motion, STROKES)
        # As the encoder of a machine rounds it, along a guide of many counts.
        read = COUNT * np.round((curves + GUIDE) / COUNT) - GUIDE
    else:
        read = curves + random.uniform(-COUNT / 2.0, COUNT / 2.0, curves.shape)
    inputs = [Input("encoder", COUNT / math.sqrt(12.0)), Input("map", NOISE, POINTS, seen)]
    strokes = [(X / 0.3, X, curve + (errors if seen else 0.0)) for curve in read]
    return stated("after", "forward", strokes, inputs)


def coverage(seen, draws, motion=0.0):
    """By line, the fractions of the intervals with their correction and without it that hold the true straightness, the
    mean over strokes without end, whose height is the mean one."""
    random, held = np.random.default_rng(1), np.zeros((draws, len(LINES), 2))
    others = SHAPE + moving(random, motion, 40 if motion else 1)
    for draw in range(draws):
        errors = cubic_spline(POINTS, random.normal(0.0, NOISE, POINTS.size))(X)
        found = measured(random, seen, errors, motion)
        of_strokes = [about_lines(X, curve + (0.0 if seen else errors), np.ones_like(X)) for curve in others]
        truth = {line: np.mean([one[line] for one in of_strokes]) for line in LINES}
        for row, one in zip(held[draw], found, strict=True):
            row[:] = [abs(value - truth[one.line]) <= one.expanded_uncertainty for value in (one.value, one.measured)]
    return dict(zip(LINES, held.mean(axis=0).tolist(), strict=True))


@pytest.mark.nightly
@pytest.mark.parametrize(("seen", "motion"), [(True, 0.0), (False, 0.0), (False, 20e-9)])
def test_of_1000_intervals_93_to_97_percent_hold_the_straightness_about_each_line(seen, motion):
    for line, (corrected, _) in coverage(seen, 1000, motion).items():
        assert 0.93 <= corrected <= 0.97, line


@pytest.mark.parametrize("seen", [True, *nightly([False])])
def test_most_intervals_hold_and_without_the_correction_for_extremes_fewer_do(seen):
    for line, (corrected, uncorrected) in coverage(seen, 20).items():
        assert corrected >= 0.85 and uncorrected < (0.4 if seen else 0.95), line


def test_a_budget_lists_each_contribution_and_repeatability_contains_the_encoder_s():
    for one in measured(np.random.default_rng(2), False, 0.0):
        repeatability, encoder, survey = one.budget
        assert repeatability.counts and not encoder.counts and survey.counts and not one.unknown
        assert one.expanded_uncertainty == pytest.approx(2.0 * math.hypot(repeatability.share, survey.share))
        assert encoder.correction < 0.0 < survey.correction
        assert one.value == pytest.approx(one.measured + encoder.correction + survey.correction)
        for line in one.to_display()["budget"]:
            assert line["sensitivity"] * line["standard_uncertainty_um"] == pytest.approx(line["share_um"])
        # A nanometre is not shown as none.
        small = {**one.to_display(), "value_um": 0.00023, "budget": [{**line, "share_um": 0.00041}]}
        assert [float(budget_rows([small])[0][name]) for name in ("value_um", "u_map_um")] == [0.00023, 0.00041]
        # Of eight strokes: s/√8, and k = 2 is to hold as much as t = 2.43 of seven degrees of freedom.
        assert repeatability.share == pytest.approx(repeatability.uncertainty / math.sqrt(8.0) * 2.43 / 2.0, rel=1e-3)


def test_a_curve_that_is_known_exactly_has_the_straightness_that_it_has_without_draws():
    curve = np.random.default_rng(3).normal(0.0, 1e-6, (1, X.size)) + 1e-5 * X
    ends = statement._extremes(curve, np.zeros((1, X.size, 1)), np.ones((X.size, 1), bool))
    (found,) = statement._straightness(X, *ends)
    assert found == pytest.approx([*about_lines(X, curve[0], np.ones_like(X)).values()], rel=1e-9)


@pytest.mark.parametrize(("noise", "motion", "within"), [(NOISE, 0.0, 0.15), (NOISE, NOISE, 0.2), (0.0, 0.0, 0.2)])
def test_what_readings_add_to_a_straightness_is_what_drawn_strokes_show(noise, motion, within):
    """By brute force: strokes whose readings have this ``noise``, and a platform that moves itself. Without any the
    readings stand still, and the truth has what they hide."""
    random = np.random.default_rng(5)

    def drawn(half):
        return math.sqrt(3.0) * half * random.uniform(-1.0, 1.0, X.size)

    true = [SHAPE + random.normal(0.0, motion, X.size) if motion else SHAPE for _ in range(80)]
    read = [one + drawn(noise) for one in true]
    of_read, of_true = ([[*about_lines(X, one, np.ones_like(X)).values()] for one in of] for of in (read, true))
    if not noise:
        # Each piece of x hides an error of its own.
        hidden = [np.interp(X, X[10::20], drawn(NOISE)[10::20]) for _ in range(80)]
        of_true = [[*about_lines(X, SHAPE + one, np.ones_like(X)).values()] for one in hidden]
    added = np.subtract(of_read, of_true)
    strokes = [(X / 0.3, X, one) for one in read]
    found = stated("after", "forward", strokes, [Input("encoder", NOISE)])
    for one, by_line in zip(found, added.T, strict=True):
        assert one.budget[1].correction == pytest.approx(-by_line.mean(), rel=within)
        # Of the mean of eighty strokes.
        assert 0.6 < one.budget[1].share / (by_line.std() / math.sqrt(80.0)) < 4.0
        assert one.measured == pytest.approx(np.mean(of_read, axis=0)[LINES.index(one.line)], rel=1e-3)


def test_errors_of_a_map_that_no_encoder_sees_widen_the_truth_as_drawn_ones_do():
    random = np.random.default_rng(6)
    straight = about_lines(X, SHAPE, np.ones_like(X))
    errors = (cubic_spline(POINTS, random.normal(0.0, NOISE, POINTS.size))(X) for _ in range(600))
    drawn = np.array([[*about_lines(X, SHAPE + one, np.ones_like(X)).values()] for one in errors])
    strokes = [(X / 0.3, X, SHAPE)]
    found = stated("after", "forward", strokes, [Input("map", NOISE, POINTS, seen=False)], repeats=False)
    for one, of_line in zip(found, drawn.T, strict=True):
        assert one.budget[0].correction == pytest.approx(of_line.mean() - straight[one.line], rel=0.25)
        assert one.budget[0].share == pytest.approx(of_line.std(), rel=0.2)
    # They are the same in all strokes, and what one error in all does is that of one.
    again = stated("after", "forward", 4 * strokes, [Input("map", NOISE, POINTS, seen=False)], repeats=False)
    for one, four in zip(found, again, strict=True):
        assert four.budget[0].share == pytest.approx(one.budget[0].share, rel=0.05) and four.strokes == 4
    # An error that is everywhere the same is none of straightness.
    form = np.ones((POINTS.size, 1))
    for one in stated("after", "forward", strokes, [Input("map", NOISE, POINTS, False, form)], repeats=False):
        assert one.budget[0].share == pytest.approx(0.0, abs=1e-15)


def test_a_smoothed_map_has_as_many_independent_points_as_its_smaller_error_leaves_information(cosine_map):
    x = np.linspace(0.0, 1.76, 353)
    random = np.random.default_rng(7)
    survey = one_run(x, 10e-6 * np.cos(2.0 * np.pi * 2.5 * x / 1.76) + random.normal(0.0, 0.2e-6, x.size))
    smooth, rough = (StraightnessMap(survey, MapParameters(smooth=how)) for how in ("auto", "none"))
    for one in (smooth, rough):
        of_map = map_input(one, seen=True)
        assert of_map.points[[0, -1]] == pytest.approx(one.span) and of_map.seen
        # As much information: so many errors of the map tell of a mean what those of the survey's points tell.
        ratio = of_map.points.size / of_map.uncertainty**2 / (x.size / one.noise.point**2)
        assert ratio == pytest.approx(1.0, rel=0.05)
    assert map_input(smooth, True).points.size < 0.5 * x.size and map_input(rough, True).points.size == x.size
    # No curve has more points at which errors could differ, and two hundred thousand would take minutes.
    many = StraightnessMap(one_run(np.linspace(0.0, 1.76, 9001), np.zeros(9001)), MapParameters(smooth="none"))
    assert map_input(many, True).points.size == statement.POINTS


def test_pieces_of_a_way_are_equal_and_their_mean_curve_is_that_of_all_strokes():
    place = statement._piece_of(X)
    assert (place.min(), place.max()) == (0, 199) and np.ptp(np.bincount(place)) <= 1
    x, mean, samples = statement._mean_curve([(X, X, SHAPE), (X, X, 3.0 * SHAPE)])
    assert x == pytest.approx([X[place == one].mean() for one in range(200)])
    assert mean == pytest.approx([2.0 * SHAPE[place == one].mean() for one in range(200)])
    assert samples == pytest.approx(np.bincount(place))


@pytest.mark.parametrize(("points", "certain", "left"), [(3, None, True), (4, None, False), (5, 2, True)])
def test_errors_at_fewer_points_than_a_cubic_has_or_of_none_at_one_are_left_in_the_curve(points, certain, left):
    errors = np.random.default_rng(3).normal(0.0, NOISE, (points, 100))
    errors[certain if certain is not None else slice(0)] = 0.0
    found = statement._without(np.linspace(X[0], X[-1], points), errors, X, SHAPE)
    assert np.array_equal(found, SHAPE) == left and np.isfinite(found).all()


def test_the_same_run_gives_the_same_statements_to_the_bit():
    first, second = (measured(np.random.default_rng(2), True, 0.0) for _ in range(2))
    assert first == second


def test_what_a_run_does_not_tell_is_named_and_left_out(make_record, assessed):
    found = assessed(make_record(), parameters={"driver": {"stage.encoder.y_resolution": COUNT}}).as_json()
    before, after = (found["straightness"][row] for row in (0, 3))
    assert (before["when"], before["line"], before["unknown"]) == ("before", "least_squares", ["map"])
    assert (after["when"], after["strokes"], after["unknown"]) == ("after", 1, ["repeatability", "map"])
    assert before["value_um"] == pytest.approx(found["straightness_before_least_squares_forward_um"], abs=1e-3)
    # The platform follows to a count, which is the encoder's error and no deviation: the truth is straight.
    assert after["measured_um"] == pytest.approx(0.1, abs=0.02)
    assert after["value_um"] == pytest.approx(0.0, abs=0.03)
    # The encoder's share alone is an uncertainty, where the rest is named; no share at all is none.
    assert before["expanded_uncertainty_um"] is None and after["expanded_uncertainty_um"] > 0.0
    record = make_record(truth=False)
    silent = assessed(record, coil_current=np.full(record.time.size, np.nan))
    before, after = (silent.as_json()["straightness"][row] for row in (0, 3))
    assert after["unknown"] == ["repeatability", "encoder", "map"]
    assert before["expanded_uncertainty_um"] is after["standard_uncertainty_um"] is None
    assert {row["expanded_uncertainty_um"] for row in budget_rows(silent.straightness)} == {"?"}
    for row in rows_of(silent.evaluation, {}):
        assert row.before_least_squares_U_um is row.after_minimum_zone_U_um is None


def test_a_centred_reference_is_not_the_guide(make_record, assessed, cosine_map):
    record = make_record(truth=False)
    centred = replace(record, y=record.y - record.r, r=np.zeros_like(record.r))
    by_map, followed = (assessed(one, map=cosine_map).as_json() for one in (centred, record))
    for name in ("uncompensated_pp_um", "straightness_before_least_squares_forward_um"):
        assert by_map[name] == pytest.approx(followed[name])
    assert by_map["residual_pp_um"] == pytest.approx(by_map["uncompensated_pp_um"], rel=0.02)
    before, after = (by_map["straightness"][row] for row in (0, 3))
    assert before == followed["straightness"][0] and after["measured_um"] == pytest.approx(
        before["measured_um"], rel=0.02
    )
    assert assessed(centred).as_json()["straightness"] == []


def test_a_stroke_in_parts_is_stated_as_a_whole_and_shorter_ones_are_left_out(make_record, assessed, cosine_map):
    record = make_record(truth=False)
    stroke, _ = record.motion.strokes
    third, fifth = (stroke.start + (stroke.stop - stroke.start) // parts for parts in (3, 5))
    # A stop on the way forward, and after the way back the begin of another way forward.
    stop, short = np.full(400, third), np.append(np.arange(fifth), np.full(400, fifth))
    order = np.concatenate([np.arange(third), stop, np.arange(third, record.time.size), short])
    columns = {name: values[order] for name, values in record.columns().items()}
    stepped = replace(record, **columns | {"time": np.arange(order.size) * 5e-4})
    assert len(stepped.motion.strokes) == 4
    whole, found = (assessed(one, map=cosine_map).as_json()["straightness"] for one in (record, stepped))
    for one, other in zip(whole, found, strict=True):
        assert (other["strokes"], other["left_out"]) == (1, int(one["direction"] == "forward"))
        assert other["value_um"] == pytest.approx(one["value_um"], abs=0.02)


@pytest.mark.parametrize("samples", [500, 2000])
def test_a_quick_stroke_states_the_same_straightness_both_ways(assessed, cosine_map, samples):
    # Over a slope of the guide, there and back, with ramps.
    there = 0.5 + 0.04 * 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, samples)))
    rest = np.full(300, 0.5)
    x = np.concatenate([rest, there, rest + 0.04, there[::-1], rest])
    r = cosine_map.evaluate(x)[0]
    record = StrokeRecord(np.arange(x.size) * 1e-3, x, r, r, 0.0 * x, "law")
    parameters = {"driver": {"stage.encoder.y_resolution": COUNT}}
    found = statements(assessed(record, map=cosine_map, parameters=parameters).evaluation)
    before = [[one for one in found if (one.when, one.direction) == ("before", way)] for way in WAYS]
    assert len(before[0]) == len(LINES)
    for forward, backward in zip(*before, strict=True):
        assert backward.measured == pytest.approx(forward.measured, rel=1e-3)
        assert backward.value == pytest.approx(forward.value, rel=1e-3)
        assert backward.value == pytest.approx(backward.measured, rel=0.05)
        assert backward.expanded_uncertainty == pytest.approx(forward.expanded_uncertainty, rel=0.2)


def test_a_stroke_that_the_sensor_measured_in_part_is_left_out(make_record, assessed, cosine_map, monkeypatch):
    monkeypatch.setattr(statement, "_DRAWS", 2)
    monkeypatch.setattr(statement, "_CURVES", 2)
    record = make_record()
    guide, (forward, _) = cosine_map.deviations(record.x), record.motion.strokes
    part = (np.arange(guide.size) - forward.start) / (forward.stop - forward.start)
    both, one_way = {"forward": 0, "backward": 0}, {"backward": 0}
    # The sensor began late, or lost the straight edge in the middle.
    for first, last, stated_ways in ((0.25, 0.75, one_way), (0.0, 0.05, both), (0.0, 0.5, one_way)):
        began = np.where((part >= first) & (part < last), np.nan, guide)
        found = statements(assessed(record, guide=began, map=cosine_map).evaluation, 0.01e-6)
        assert {one.direction: one.left_out for one in found} == stated_ways
    # Of two strokes each way the mean is that of the other one.
    columns = {name: np.append(of, of) for name, of in record.columns().items()}
    twice = replace(record, **columns | {"time": np.arange(2 * guide.size) * 5e-4})
    found = statements(assessed(twice, guide=np.append(began, guide), map=cosine_map).evaluation, 0.01e-6)
    assert {(one.direction, one.strokes, one.left_out) for one in found} == {("forward", 1, 1), ("backward", 2, 0)}
    assert statements(assessed(record, guide=np.full(guide.size, np.nan), map=cosine_map).evaluation, 0.01e-6) == []


def test_a_recorded_sensor_takes_the_place_of_the_map(make_record, assessed, cosine_map):
    record = make_record()
    seen = assessed(record, guide=0.5 * cosine_map.deviations(record.x), map=cosine_map).evaluation
    by_map, by_sensor = (statements(seen, sensor)[0] for sensor in (None, 0.01e-6))
    assert by_sensor.measured == pytest.approx(0.5 * by_map.measured, rel=1e-3)
    assert [one.name for one in by_map.budget] == ["map"]
    assert [one.name for one in by_sensor.budget] == ["repeatability", "sensor"]
    # Both extremes have the sensor's uncertainty, some more than one place is the extreme.
    assert by_sensor.expanded_uncertainty == pytest.approx(2.0 * math.sqrt(2.0) * 0.01e-6, rel=0.4)
