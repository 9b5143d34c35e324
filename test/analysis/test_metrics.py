"""The figures of a run, on records whose figures are known."""

import dataclasses

import numpy as np
import pytest

from straightcomp_ros.analysis.metrics import MetricsError, evaluate
from straightcomp_ros.analysis.record import find_motion


def _wave(profile, amplitude):
    return amplitude * np.sin(2.0 * np.pi * 7.0 * profile[0])


def test_of_a_perfect_servo_the_encoder_sees_its_own_quantum_and_the_truth_nothing(make_record, cosine_map):
    metrics = evaluate(make_record(), cosine_map)
    assert (metrics.true_pp, metrics.residual_pp) == pytest.approx((0.0, 0.0), abs=1e-15)
    assert metrics.encoder_pp == pytest.approx(0.1e-6, rel=0.01)
    assert metrics.encoder_rms == pytest.approx(0.1e-6 / np.sqrt(12.0), rel=0.1)
    # The made-up current alternates between ±1 mA.
    assert metrics.control_rms_step == pytest.approx(2e-3)
    assert metrics.control_activity == pytest.approx(2e-3 * (metrics.samples - 1))
    assert metrics.duration == pytest.approx(2.0 * (1.76 / 0.3 + 1.5) + 0.25, abs=0.01)
    assert metrics.samples == round(metrics.duration / 5e-4) + 1


def test_a_constant_error_counts_in_the_rms_alone_and_figures_are_shown_in_micrometres(make_record, cosine_map):
    metrics = evaluate(make_record(0.3e-6), cosine_map)
    shown = metrics.to_display()
    assert metrics.true_pp == pytest.approx(0.0, abs=1e-15)
    assert shown["true_rms_um"] == pytest.approx(0.3)
    assert (shown["control_rms_step_A"], shown["duration_s"]) == (metrics.control_rms_step, metrics.duration)
    assert len(shown) == len(dataclasses.fields(metrics))


def test_a_wave_is_measured_from_peak_to_peak(make_record, cosine_map, motion_profile):
    metrics = evaluate(make_record(_wave(motion_profile, 0.2e-6), quantum=1e-12), cosine_map)
    assert metrics.true_pp == pytest.approx(0.4e-6, rel=1e-3)
    assert metrics.true_rms == pytest.approx(0.2e-6 / np.sqrt(2.0), rel=1e-3)
    assert metrics.encoder_pp == pytest.approx(0.4e-6, rel=1e-3)
    assert metrics.encoder_rms == pytest.approx(0.2e-6 / np.sqrt(2.0), rel=1e-3)
    assert metrics.residual_pp == pytest.approx(0.4e-6, rel=0.01)
    assert metrics.residual_encoder_pp == pytest.approx(0.4e-6, rel=0.01)


def test_an_error_that_changes_sign_with_the_direction_shows_only_over_both(make_record, cosine_map, motion_profile):
    time, x = motion_profile
    metrics = evaluate(make_record(0.1e-6 * np.sign(np.gradient(x, time))), cosine_map)
    assert metrics.true_pp_forward == pytest.approx(0.0, abs=1e-15)
    assert metrics.true_pp_backward == pytest.approx(0.0, abs=1e-15)
    assert metrics.true_pp == pytest.approx(0.2e-6)
    assert metrics.residual_pp == pytest.approx(0.2e-6, rel=1e-3)


def test_the_pause_counts_in_the_error_and_not_in_the_straightness(make_record, cosine_map, motion_profile):
    forward, backward = find_motion(make_record()).strokes
    error = np.zeros(motion_profile[0].size)
    error[(forward.stop + backward.start) // 2] = 1e-6
    metrics = evaluate(make_record(error), cosine_map)
    assert metrics.true_pp == pytest.approx(1e-6)
    assert metrics.true_pp_forward == metrics.true_pp_backward == pytest.approx(0.0, abs=1e-15)
    assert metrics.residual_pp == pytest.approx(0.0, abs=1e-15)


def test_what_happens_before_and_after_the_motion_does_not_count(make_record, cosine_map, motion_profile):
    error = np.zeros(motion_profile[0].size)
    error[:100] = error[-100:] = np.nan
    metrics = evaluate(make_record(error), cosine_map)
    assert metrics.true_pp == pytest.approx(0.0, abs=1e-15)


def test_the_uncompensated_straightness_is_that_of_the_guide(make_record, cosine_map):
    # A cosine of 2.5 waves has a trend: beside its least squares line over 0..L, by closed form.
    x = np.linspace(0.0, 1.0, 100_001)
    cosine = 10e-6 * np.cos(5.0 * np.pi * x)
    slope = 12.0 * 10e-6 * -2.0 / (5.0 * np.pi) ** 2
    guide = np.ptp(cosine - slope * (x - 0.5))
    for truth in (True, False):
        assert evaluate(make_record(truth=truth), cosine_map).uncompensated_pp == pytest.approx(guide, rel=2e-4)


def test_an_error_of_the_map_shows_in_the_true_residual_and_not_in_the_encoders(make_record, cosine_map):
    record = make_record(quantum=1e-12)
    assert record.guide is not None and record.true_x is not None
    wrong = 0.05e-6 * np.cos(2.0 * np.pi * 8.0 * record.true_x / 1.76)
    metrics = evaluate(dataclasses.replace(record, guide=record.guide + wrong), cosine_map)
    assert metrics.residual_pp == pytest.approx(0.1e-6, rel=1e-3)
    assert metrics.residual_encoder_pp < 0.001e-6
    assert metrics.true_pp == pytest.approx(0.0, abs=1e-15)


def test_a_tilt_of_the_platforms_axis_is_no_lack_of_straightness(make_record, cosine_map, motion_profile):
    metrics = evaluate(make_record(5e-6 * motion_profile[1]), cosine_map)
    assert metrics.residual_pp == pytest.approx(0.0, abs=1e-14)
    assert metrics.true_pp == pytest.approx(8.8e-6, rel=1e-5)


def test_without_truth_the_true_figures_are_missing(make_record, cosine_map):
    metrics = evaluate(make_record(truth=False), cosine_map)
    assert metrics.true_pp is metrics.true_rms is metrics.true_pp_forward is metrics.true_pp_backward is None
    assert metrics.residual_pp == metrics.residual_encoder_pp
    assert metrics.to_display()["true_pp_um"] is None


@pytest.mark.parametrize(
    ("column", "value"),
    [*((name, np.nan) for name in ("x", "y", "r", "current", "true_x", "true_y", "guide")), ("y", np.inf)],
)
def test_what_is_not_finite_is_refused_with_its_place(make_record, cosine_map, column, value):
    record = make_record()
    values = record.columns()[column].copy()
    values[5000] = value
    with pytest.raises(MetricsError, match=rf"record: {column} is {value} at sample 5000 \(2.5 s\)"):
        evaluate(dataclasses.replace(record, **{column: values}), cosine_map)
