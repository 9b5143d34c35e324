"""Each verdict on a made-up run, and beside it the nearest run that is in order."""

import math

import numpy as np
import pytest

from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.analysis.judgement import WORDS, Verdict, worst
from straightcomp_ros.analysis.run_verdict import Bounds, GuideFit, JudgedMotion, bounds_of, encoder_count, verdict_of

T = 5e-4
TIME = np.arange(16_000) * T
R = 10e-6 * np.sin(2.0 * np.pi * 0.3 * TIME)
SMALL = 0.05e-6 * np.sin(2.0 * np.pi * 0.9 * TIME)
FITS = GuideFit(20e-6, 6e-6, 0.2e-6, 0.04e-6)


def course(error=SMALL, r=R, **changes) -> JudgedMotion:
    values = {
        "time": TIME,
        "x": np.linspace(0.0, 1.76, TIME.size),
        "y": r - error,
        "r": r,
        "current": np.zeros_like(TIME),
        "error": error,
        "true": True,
        "count": 0.1e-6,
        "fit": FITS,
    }
    return JudgedMotion(**{**values, **changes})


def word(one: JudgedMotion, bounds: Bounds | None = None) -> str:
    return verdict_of(one, bounds or Bounds()).verdict


def bump(at: float, height: float, length: float = 0.02) -> np.ndarray:
    return height * np.exp(-0.5 * ((TIME - at) / length) ** 2)


def test_a_small_error_is_in_order_and_its_numbers_are_told():
    found = verdict_of(course(), Bounds())
    assert found.in_order and "0.1 µm p-p" in found.reason and "20 µm" in found.reason


def test_an_error_made_in_a_stall_is_the_host_s_and_without_the_stall_it_is_the_law_s():
    error = SMALL + bump(4.0, 2e-6)
    stall = Stall(3.95, 4.02)
    found = verdict_of(course(error, stalls=(stall,)), Bounds())
    assert found.verdict == "starved" and "70.0 ms" in found.reason and "2.02 µm" in found.reason
    assert word(course(error)) == "in_order"
    assert word(course(error, stalls=(Stall(6.0, 6.07),))) == "in_order"


def test_a_stall_that_did_no_harm_leaves_a_run_in_order():
    assert word(course(stalls=(Stall(4.0, 4.1),))) == "in_order"
    raised = verdict_of(course(SMALL + bump(4.0, 0.09e-6), stalls=(Stall(3.95, 4.02),)), Bounds())
    assert raised.in_order and "without the stalls of the host (1)" in raised.reason


def test_a_doubled_error_within_a_count_of_the_encoder_is_no_harm():
    error = SMALL + bump(4.0, 0.3e-6)
    stalls = (Stall(3.95, 4.02),)
    assert word(course(error, stalls=stalls)) == "starved"
    assert word(course(error, stalls=stalls, count=1e-6)) == "in_order"


def test_a_loop_that_fails_without_its_stalls_too_has_another_reason():
    error = 3e-6 * np.sin(2.0 * np.pi * 30.0 * TIME) + bump(4.0, 30e-6)
    stalls = (Stall(3.95, 4.02),)
    assert word(course(error, 0.2 * R, fit=None, stalls=stalls)) == "oscillates"
    assert word(course(0.01 * error, 0.2 * R, fit=None, stalls=stalls)) == "starved"


def test_a_run_of_stalls_is_starved_only_if_its_figures_are_bad():
    stalls = tuple(Stall(t, t + 0.01) for t in np.arange(0.0, 8.0, 0.1).tolist())
    bad = verdict_of(course(R, stalls=stalls), Bounds())
    assert bad.verdict == "starved" and "disturbed 100%" in bad.reason and "stands still" in bad.reason
    assert word(course(stalls=stalls)) == "in_order"
    peak = verdict_of(course(SMALL + bump(4.0, 2e-6, 0.005), stalls=stalls), Bounds())
    assert peak.verdict == "starved" and "error 2.02 µm p-p" in peak.reason
    assert word(course(SMALL + bump(4.0, 0.15e-6, 0.005), stalls=stalls)) == "in_order"


def test_a_platform_that_reached_its_stop_is_at_the_stop_whatever_else():
    bounds = Bounds(stop=1.2e-3)
    fallen = R - 1.2e-3
    assert word(course(fallen), bounds) == "at_stop"
    assert word(course(y=np.full_like(R, 1.1e-3)), bounds) == "in_order"
    assert word(course(y=np.full_like(R, 1.2e-3))) == "in_order"


def test_a_stage_beyond_survey_and_run_out_left_the_map():
    assert word(course(), Bounds(first=-0.02, last=1.76)) == "in_order"
    found = verdict_of(course(), Bounds(first=-0.02, last=1.75))
    assert found.verdict == "left_map" and "-20 mm to 1750 mm" in found.reason
    assert word(course(), Bounds(first=0.001, last=2.0)) == "left_map"


def test_a_law_that_stays_at_its_limit_is_saturated_and_one_that_touches_it_is_not():
    bounds = Bounds(current=0.9)
    pushed = np.where(TIME < 1.0, 0.9, 0.1)
    found = verdict_of(course(current=pushed), bounds)
    assert found.verdict == "saturated" and "0.9 A" in found.reason
    assert word(course(current=np.where(TIME % 1.0 < 0.01, 0.9, 0.1)), bounds) == "in_order"
    assert word(course(current=pushed), Bounds(current=1.0)) == "in_order"


def test_a_short_stay_at_the_limit_counts_if_the_error_is_made_there():
    pushed = np.where(np.abs(TIME - 4.0) < 0.1, 0.9, 0.1)
    assert word(course(current=pushed), Bounds(current=0.9)) == "in_order"
    assert word(course(SMALL + bump(4.0, 2e-6), current=pushed), Bounds(current=0.9)) == "saturated"


def test_an_oscillation_that_reaches_both_limits_in_turn_oscillates():
    swing = np.sin(2.0 * np.pi * 40.0 * TIME)
    found = verdict_of(course(1e-4 * swing, current=0.9 * np.sign(swing)), Bounds(current=0.9))
    assert found.verdict == "oscillates" and "40 Hz" in found.reason and "100 µm" in found.reason


@pytest.mark.parametrize(
    "fit, expected",
    [
        (GuideFit(20e-6, 6e-6, 27e-6, 8e-6), "wrong_guide"),
        (GuideFit(20e-6, 6e-6, 20e-6, 6e-6), "wrong_guide"),
        (GuideFit(20e-6, 6e-6, 8e-6, 3e-6), "in_order"),
        (None, "in_order"),
    ],
)
def test_a_map_that_explains_less_than_half_of_the_guide_is_another_guide_s(fit, expected):
    assert word(course(fit=fit)) == expected


def test_on_a_stroke_so_short_that_the_guide_is_a_line_the_survey_s_noise_proves_nothing():
    assert word(course(fit=GuideFit(0.3e-6, 0.1e-6, 0.3e-6, 0.1e-6))) == "in_order"


def test_a_platform_that_does_not_follow_says_nothing_about_the_map():
    assert word(course(R, fit=GuideFit(20e-6, 6e-6, 27e-6, 8e-6))) == "inaccurate"


@pytest.mark.parametrize("frequency", [12.0, 150.0])
def test_an_oscillation_counts_from_a_count_of_the_encoder_and_a_share_of_the_error_on(frequency):
    line = np.sin(2.0 * np.pi * frequency * TIME)
    found = verdict_of(course(SMALL + 0.15e-6 * line), Bounds())
    assert found.verdict == "oscillates" and f"{frequency:.0f} Hz" in found.reason
    assert word(course(SMALL + 0.08e-6 * line)) == "in_order"
    assert word(course(SMALL + 0.15e-6 * line, count=1e-6)) == "in_order"
    assert word(course(16.0 * SMALL + 0.15e-6 * line)) == "in_order"


def test_a_fine_encoder_does_not_make_an_oscillation_of_what_the_guide_hides():
    line = 0.06e-6 * np.sin(2.0 * np.pi * 150.0 * TIME)
    assert word(course(0.1 * SMALL + line, count=1e-9)) == "in_order"
    assert word(course(0.1 * SMALL + line, r=0.1 * R, count=1e-9, fit=None)) == "oscillates"


def test_samples_that_are_missing_do_not_hide_an_oscillation():
    kept = np.ones(TIME.size, dtype=bool)
    kept[::97] = False
    one = course(SMALL + 0.3e-6 * np.sin(2.0 * np.pi * 150.0 * TIME))
    columns = {name: getattr(one, name)[kept] for name in ("time", "x", "y", "r", "current", "error")}
    assert word(course(**columns)) == "oscillates"


def test_an_error_of_half_the_uncompensated_deviation_is_inaccurate():
    assert word(course(0.45 * R)) == "in_order"
    assert word(course(0.55 * R)) == "inaccurate"
    assert word(course(R)) == "inaccurate"


def test_on_a_nearly_straight_guide_the_encoder_s_counts_are_no_fault_of_the_law():
    nearly = 0.02 * R
    assert word(course(0.7 * nearly, nearly, fit=None)) == "in_order"
    assert word(course(0.7 * nearly, nearly, fit=None, count=0.01e-6)) == "inaccurate"
    assert word(course(1.3 * nearly, nearly, fit=None)) == "inaccurate"


def test_an_uncompensated_run_is_in_order_and_says_so():
    still = 1e-9 * np.sin(TIME)
    found = verdict_of(course(SMALL, still, fit=GuideFit(20e-6, 6e-6, 20e-6, 6e-6)), Bounds())
    assert found.in_order and "uncompensated" in found.reason


def test_a_run_of_several_is_named_by_its_number():
    good, bad = Verdict("in_order", "error 1 µm"), Verdict("at_stop", "|y| is large")
    assert worst([good, bad, good], "start") == Verdict("at_stop", "start 2 of 3: |y| is large")
    assert worst([bad], "start") == bad and worst([good, good], "start") == good


def test_a_verdict_reads_as_words():
    assert str(Verdict("left_map", "the stage moved")) == "left map: the stage moved"
    assert len(set(WORDS)) == len(WORDS) and all(one == one.lower() and " " not in one for one in WORDS)


def test_bounds_come_from_what_the_parameters_name_and_from_defaults():
    assert bounds_of({}) == Bounds()
    named = {"driver": {"stage.platform.stop": 1e-3}, "controller": {"stage.actuator.current_limit": 0.5}}
    assert bounds_of(named)[:2] == (0.5, 1e-3)
    assert bounds_of({"driver": {}, "controller": {}})[:2] == (0.9, 1.2e-3)
    weak = {"stage.drive.gain": 0.01, "stage.drive.dac_bits": 4}
    assert bounds_of({"driver": weak, "controller": {}}).current == pytest.approx(7 * 0.2 / 16)


def test_a_real_board_does_not_tell_its_stop_and_an_emulated_one_does():
    board = {"hardware": "can", "stage.platform.stop": 1e-3}
    assert bounds_of({"driver": board}).stop == math.inf
    assert bounds_of({"driver": {**board, "can.simulated_stage": True}}).stop == 1e-3


def test_the_count_of_the_encoder_is_the_smallest_step_of_its_readings():
    assert encoder_count(np.array([3.0, 1.0, 2.0, 1.0]) * 1e-7) == pytest.approx(1e-7)
    assert encoder_count(np.array([1e-7, 1e-7 + 1e-20])) == 0.0
