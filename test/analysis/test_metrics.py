"""The figures of a run, on records whose figures are known."""

import dataclasses
import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pytest import approx

from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.metrics import evaluate, force_balance, residual_of_stroke, standstill_figures
from straightcomp_ros.analysis.record import MetricsError, StrokeRecord
from straightcomp_ros.analysis.run_verdict import verdict_on
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.offline.simulation import Simulation

ERRORS = {
    "none": lambda time, x: 0.0,
    "constant": lambda time, x: 0.3e-6,
    "wave": lambda time, x: 0.2e-6 * np.sin(2.0 * np.pi * 7.0 * time),
    "changes its sign with the direction": lambda time, x: 0.1e-6 * np.sign(np.gradient(x, time)),
    "tilt of the platform's axis": lambda time, x: 5e-6 * x,
}


@pytest.mark.parametrize(
    ("error", "quantum", "names", "value", "rel"),
    [
        ("none", 1e-7, "true_pp residual_pp", 0.0, 0.0),
        # The encoder sees its own quantum.
        ("none", 1e-7, "encoder_pp", 1e-7, 0.01),
        ("none", 1e-7, "encoder_rms", 1e-7 / np.sqrt(12.0), 0.1),
        ("constant", 1e-12, "true_pp", 0.0, 0.0),
        ("constant", 1e-12, "true_rms", 0.3e-6, 1e-6),
        ("wave", 1e-12, "true_pp encoder_pp", 0.4e-6, 1e-3),
        ("wave", 1e-12, "true_rms encoder_rms", 0.2e-6 / np.sqrt(2.0), 1e-3),
        ("wave", 1e-12, "residual_pp residual_encoder_pp", 0.4e-6, 0.01),
        ("changes its sign with the direction", 1e-12, "true_pp_forward true_pp_backward", 0.0, 0.0),
        ("changes its sign with the direction", 1e-12, "true_pp residual_pp", 0.2e-6, 1e-3),
        # That is no lack of straightness.
        ("tilt of the platform's axis", 1e-12, "residual_pp", 0.0, 0.0),
        ("tilt of the platform's axis", 1e-12, "true_pp", 8.8e-6, 1e-5),
    ],
)
def test_a_known_error_has_figures_in_closed_form(
    make_record, cosine_map, motion_profile, error, quantum, names, value, rel
):
    metrics = evaluate(make_record(ERRORS[error](*motion_profile), quantum=quantum), cosine_map)
    for name in names.split():
        assert getattr(metrics, name) == approx(value, rel=rel, abs=1e-14)


def test_current_and_duration_are_those_of_the_window_and_figures_are_shown_in_micrometres(make_record, cosine_map):
    metrics = evaluate(make_record(0.3e-6), cosine_map)
    # The made-up current alternates between ±1 mA.
    assert metrics.control_rms_step == approx(2e-3)
    assert metrics.control_activity == approx(2e-3 * (metrics.samples - 1))
    assert metrics.duration == approx(2.0 * (1.76 / 0.3 + 1.5) + 0.25, abs=0.01)
    assert metrics.samples == round(metrics.duration / 5e-4) + 1
    shown = metrics.to_display()
    assert shown["true_rms_um"] == approx(0.3) and len(shown) == len(dataclasses.fields(metrics))
    assert (shown["control_rms_step_A"], shown["duration_s"]) == (metrics.control_rms_step, metrics.duration)


def test_the_pause_counts_in_the_error_only_and_what_is_outside_the_motion_nowhere(
    make_record, cosine_map, motion_profile
):
    forward, backward = make_record().motion.strokes
    error = np.zeros(motion_profile[0].size)
    error[:100] = error[-100:] = np.nan
    assert evaluate(make_record(error), cosine_map).true_pp == approx(0.0, abs=1e-15)
    error[(forward.stop + backward.start) // 2] = 1e-6
    metrics = evaluate(make_record(error), cosine_map)
    assert metrics.true_pp == approx(1e-6)
    assert metrics.true_pp_forward == metrics.true_pp_backward == approx(0.0, abs=1e-15)
    assert metrics.residual_pp == approx(0.0, abs=1e-15)


def test_the_uncompensated_straightness_is_that_of_the_guide(make_record, cosine_map):
    # A cosine of 2.5 waves has a trend: from its least squares line over 0..L, by closed form.
    x = np.linspace(0.0, 1.0, 100_001)
    cosine = 10e-6 * np.cos(5.0 * np.pi * x)
    slope = 12.0 * 10e-6 * -2.0 / (5.0 * np.pi) ** 2
    guide = np.ptp(cosine - slope * (x - 0.5))
    for truth in (True, False):
        assert evaluate(make_record(truth=truth), cosine_map).uncompensated_pp == approx(guide, rel=2e-4)


def test_an_error_of_the_map_shows_in_the_true_residual_and_not_in_the_encoders(make_record, cosine_map):
    record = make_record(quantum=1e-12)
    assert record.guide is not None and record.true_x is not None
    wrong = 0.05e-6 * np.cos(2.0 * np.pi * 8.0 * record.true_x / 1.76)
    metrics = evaluate(dataclasses.replace(record, guide=record.guide + wrong), cosine_map)
    assert metrics.residual_pp == approx(0.1e-6, rel=1e-3)
    assert metrics.residual_encoder_pp < 0.001e-6
    assert metrics.true_pp == approx(0.0, abs=1e-15)


def test_without_truth_the_true_figures_are_missing(make_record, cosine_map):
    metrics = evaluate(make_record(truth=False), cosine_map)
    assert metrics.true_pp is metrics.true_rms is metrics.true_pp_forward is metrics.true_pp_backward is None
    assert metrics.residual_pp == metrics.residual_encoder_pp
    assert metrics.to_display()["true_pp_um"] is None


@pytest.mark.parametrize("column", ["x", "current", "guide"])
def test_what_is_no_number_of_a_machine_is_refused_with_its_first_place_and_how_many_there_are(
    make_record, cosine_map, column
):
    record = make_record()
    for value in (np.nan, np.inf, -1e300, 1000.0):
        values = record.columns()[column].copy()
        values[[5000, 6000]] = value
        broken = dataclasses.replace(record, **{column: values})
        for judge in (evaluate, lambda *run: verdict_on(*run, {})):
            with pytest.raises(
                MetricsError, match=rf"record: {column} is {re.escape(str(value))} at sample 5000 \(2.5 s\), one of 2"
            ):
                judge(broken, cosine_map)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_jitter_of_the_encoder_makes_no_stroke(make_record, seed):
    record = make_record()
    jitter = np.random.default_rng(seed).integers(-2, 3, record.x.size) * 1e-7
    motion = dataclasses.replace(record, x=record.x + jitter).motion
    assert [stroke.direction for stroke in motion.strokes] == ["forward", "backward"]
    assert motion.window.start == approx(record.motion.window.start, abs=4)


RATE = 2000.0
STIFFNESS = 667.0


def stroke(friction: float, noise: float = 0.0, lost: float = 0.0, half=10e-6) -> tuple[NDArray[np.float64], ...]:
    """Three waves of ± ``half`` in m in six seconds, read in counts of 0.1 µm."""
    random = np.random.default_rng(1)
    time = np.arange(0.0, 6.0, 1.0 / RATE)
    y = half * np.sin(np.pi * time)
    current = (
        0.01 - STIFFNESS * y + friction * np.sign(np.cos(np.pi * time)) + noise * random.standard_normal(time.size)
    )
    current[random.random(time.size) < lost] = np.nan
    return time, np.round(y / 1e-7) * 1e-7, current


@pytest.mark.parametrize(
    ("stage", "error", "stiffness_error"),
    [*(((friction,), 2e-5, 2e-3) for friction in (0.0, 0.007, 0.02)), ((0.007, 0.003, 0.1), 1.5e-4, 0.02)],
)
def test_friction_is_half_the_hysteresis_and_stiffness_the_slope_despite_noise(stage, error, stiffness_error) -> None:
    found = force_balance(*stroke(*stage))
    assert found.friction == approx(stage[0], abs=error)
    assert found.stiffness == approx(STIFFNESS, rel=stiffness_error)


def test_a_platform_that_rests_goes_one_way_or_moves_less_than_twice_the_bending_shows_no_friction() -> None:
    for half, known in ((1.9e-6, False), (2.6e-6, True)):
        assert math.isfinite(force_balance(*stroke(0.007, half=half)).friction) == known
    time, y, current = stroke(0.007)
    one_way = 1e-5 * time
    for case in ((time[:200], y[:200], current[:200]), (time, one_way, -667.0 * one_way)):
        assert math.isnan(force_balance(*case).friction)


def bristled(turns, bending=1.9e-6, creeping=0.0):
    """Time, y and current of a platform that goes to these y in m at 20 µm/s, whose friction of 7 mA grows over a
    ``bending`` after each reversal, and is three times as large where it creeps at this share of the speed."""
    legs = [np.linspace(a, b, 1 + round(RATE * abs(b - a) / 20e-6))[1:] for a, b in itertools.pairwise(turns)]
    y, current = np.concatenate(legs), []
    for leg in legs:
        way, gone = np.sign(leg[-1] - leg[0]), np.abs(leg - leg[0])
        current.append(0.01 - STIFFNESS * leg + way * 0.007 * np.minimum(gone / bending, 1.0))
    current = np.concatenate(current)
    if creeping:
        slow = np.arange(0.0, 3e-6, creeping * 20e-6 / RATE)
        y, current = np.append(y, y[-1] + slow), np.append(current, 0.01 - STIFFNESS * (y[-1] + slow) + 0.021)
    return np.arange(y.size) / RATE, y, current


def test_what_bends_after_a_reversal_or_creeps_is_not_sliding_and_a_little_sliding_each_way_is_enough():
    for there in (20e-6, -20e-6):
        assert force_balance(*bristled([0.0, there, 0.0, there])) == approx((0.007, STIFFNESS), rel=2e-3)
    slid = [0.0, 30e-6, 0.0, 3e-6]
    assert force_balance(*bristled(slid, creeping=0.15)) == approx((0.007, STIFFNESS), rel=0.05)
    assert force_balance(*bristled(slid, creeping=0.3)).friction > 0.008
    # 500 samples are 5 µm at this speed; 2 µm before them bend, and the filter takes some at a turn.
    for back, known in ((8.5e-6, True), (6e-6, False)):
        for way in (1.0, -1.0):
            found = force_balance(*bristled([0.0, 30e-6 * way, (30e-6 - back) * way]))
            assert math.isfinite(found.friction) == math.isfinite(found.stiffness) == known
    # What has no reading is left out.
    time, y, current = bristled([0.0, 20e-6, 0.0])
    y[500:520], current[900:950] = np.nan, np.nan
    assert force_balance(time, y, current).friction == approx(0.007, rel=0.02)


def test_the_current_at_rest_is_judged_from_200_ms_after_each_stroke_to_the_next(make_record, cosine_map):
    record = make_record()
    forward, backward = record.motion.strokes
    current = np.where(np.arange(record.time.size) % 2, 1.0, -1.0)
    current[forward.stop - 1 + 400 : backward.start] *= 1e-3
    assert evaluate(replace(record, current=current), cosine_map).resting_rms_step == approx(2e-3)
    # Not a sample more on either side.
    for at in (forward.stop - 1 + 400, backward.start - 1):
        more = current.copy()
        more[at] += 5e-3
        assert evaluate(replace(record, current=more), cosine_map).resting_rms_step > 2e-3
    only = record.part(slice(0, backward.start))
    assert evaluate(only, cosine_map).resting_rms_step is None


def test_the_reversal_is_the_error_within_100_ms_of_it_on_both_sides_of_the_pause(make_record, cosine_map):
    record = make_record(truth=False, quantum=1e-12)
    forward, backward = record.motion.strokes
    for at, seen in (
        (forward.stop - 199, 1),
        (forward.stop - 202, 0),
        (backward.start + 198, 1),
        (backward.start + 201, 0),
    ):
        y = record.y.copy()
        y[at] += 1e-6
        found = standstill_figures(replace(record, y=y), record.reference)[0].reversal_pp
        assert found == approx(1e-6 * seen, abs=1e-11)
    # In the same direction nothing is reversed.
    x = np.interp(record.time, [0.0, 0.5, 1.0, 1.5, 2.0, 20.0], [0.0, 0.0, 0.1, 0.1, 0.2, 0.2])
    once_more = replace(record, x=x)
    assert [one.reversal_pp for one in standstill_figures(once_more, record.reference)] == [None, None]


def test_figures_that_are_stated_of_a_straightness_over_x_do_not_depend_on_the_time_spent_there():
    x = np.linspace(0.0, 1.0, 501)
    deviation = 1e-5 * (x**2 + 0.2 * np.sin(9.0 * x))
    slowly = np.cumsum(1.0 + 4.0 * (x < 0.3))
    times = np.arange(0.0, slowly[-1], 0.5)
    at = np.interp(times, slowly, x)
    even, lingering = (
        residual_of_stroke(time, place, np.interp(place, x, deviation))
        for time, place in ((np.arange(x.size), x), (times, at))
    )
    assert lingering == approx(np.interp(at, x, even), abs=1e-8)


def test_ten_percent_more_friction_of_a_simulated_stage_is_seen_as_nearly_that() -> None:
    found = []
    for factor in (1.0, 1.1):
        coils: list[float] = []
        simulation = Simulation({"driver": {"simulated.truth.friction": factor}})
        record = simulation.run(observe=lambda sample, *_, coils=coils: coils.append(sample.current))
        found.append(force_balance(record.time, record.y, np.array(coils)))
    assert found[1].friction / found[0].friction == approx(1.1, abs=0.02)
    assert found[0].friction == approx(0.0075, abs=0.001)


def record_of(error, **motion):
    """A record of a cycle of this motion with ``error(time, x)`` in m."""
    trajectory = Trajectory(forward_and_back(MotionParameters(**motion)))
    time = np.arange(0.0, trajectory.end_ns * 1e-9, 5e-4)
    x = np.array([trajectory.position(round(t * 1e9)) for t in time])
    found = error(time, x)
    zero = np.zeros_like(x)
    return StrokeRecord(time=time, x=x, y=zero - found, r=zero, current=zero, law="x")


@pytest.mark.parametrize(
    ("stroke", "speed", "ramp"), [(1e-4, 0.3, 1.5), (-0.002, 0.3, 1.5), (0.002, 0.001, 0.005), (0.002, 0.001, 1.0)]
)
def test_short_and_slow_movements_have_their_own_figures(stroke, speed, ramp):
    motion = {"stroke": stroke, "speed": speed, "acceleration": speed / ramp, "settle": 0.3, "pause": 0.3}
    record = record_of(lambda time, x: 0.0 * x, **motion)
    forward, backward = record.motion.strokes
    # From a tenth of the ramp on.
    assert record.time[forward.start] == approx(0.3 + 0.05 * ramp, abs=0.05 * ramp + 0.015)
    assert forward.direction == ("forward" if stroke > 0.0 else "backward") != backward.direction
    for figures in standstill_figures(record, record.reference):
        assert (figures.settling, figures.standstill_pp, figures.standstill_rms) == (0.0, 0.0, 0.0)


def test_settling_lasts_until_the_error_stays_in_the_band_and_is_unknown_where_it_never_does():
    motion = {"stroke": 0.02, "settle": 0.2, "pause": 0.5}
    points = Trajectory(forward_and_back(MotionParameters(**motion))).waypoints
    arrival = 1e-9 * next(point.time_ns for point in points[2:] if not point.velocity)

    def decaying(time, x):
        return 3e-7 * np.exp(-np.maximum(time - arrival, 0.0) / 0.05)

    record = record_of(decaying, **motion)
    first, last = standstill_figures(record, record.reference)
    # 3e-7 falls to 1e-7 in 0.05 ln 3 s; the end of a movement is seen some ms early.
    assert first.settling == approx(0.05 * math.log(3.0), abs=0.006)
    lacking = record.part(np.flatnonzero((record.time < arrival + 0.01) | (record.time > arrival + 0.04)))
    assert standstill_figures(lacking, lacking.reference)[0].settling == first.settling
    assert first.standstill_pp < 1e-7 and last.settling == 0.0 and last.reversal_pp is None
    assert first.reversal_pp == approx(np.ptp(3e-7 * np.exp([0.0, -0.5 / 0.05])), rel=0.05)
    outside, _ = standstill_figures(record_of(lambda time, x: np.full_like(x, 2e-7), **motion), record.reference)
    assert math.isnan(outside.settling) and outside.standstill_rms == approx(2e-7)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0.139, 3, "0.139"), (22.4, 2, "22.40"), (0.00682, 3, "0.0068"), (-0.0004, 3, "-0.0004"), (0.0, 3, "0.000")],
)
def test_a_small_figure_is_shown_with_two_digits_that_count(value, digits, text):
    assert with_digits(value, digits) == text
