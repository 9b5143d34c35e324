"""The judgement of a run: figures against closed forms, limits, report."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from straightcomp_ros.analysis.assessment import checked_limits
from straightcomp_ros.analysis.error_detail import error_spectrum
from straightcomp_ros.analysis.html_report import report_html
from straightcomp_ros.analysis.metrics import StandstillFigures, evaluate
from straightcomp_ros.cli.results import shown
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.output_files import plain


def test_the_recorded_reference_gives_the_figures_of_the_map(make_record, cosine_map, motion_profile):
    record = make_record(0.3e-6 * np.sin(2 * np.pi * 7 * motion_profile[0]))
    of_map = evaluate(record, cosine_map).to_display()
    for name, value in evaluate(record, record.reference).to_display().items():
        assert value == pytest.approx(of_map[name], abs=1e-4), name


@pytest.mark.parametrize("before", [0, 1000])
def test_gaps_saturation_and_switch_off_are_reported_with_count_and_time_from_the_first_sample_with_a_reference(
    make_record, assessed, before
):
    record = make_record()
    every = np.round(record.time * 1e9).astype(np.int64)
    # So many samples come before the first reference.
    begin_ns = before * 500_000
    stamps = np.append(np.arange(before) * 500_000, begin_ns + every)
    current = record.current.copy()
    current[5000:5011] = 0.5
    on = np.ones(stamps.size, bool)
    on[before + 7000 : before + 7020] = False
    on[-50:] = False
    kept = np.delete(np.arange(stamps.size), range(before + 9000, before + 9004))
    found = assessed(replace(record, current=current), stamps=stamps[kept], amplifier_on=on[kept], begin_ns=begin_ns)
    # From the last sample before the gap to the first one after it.
    assert found.gaps == [pytest.approx((4.4995, 4.502, 4))]
    assert found.saturated == [pytest.approx((2.5, 2.505, 11))]
    # Switched off at the end, when the stage stands, is no fault.
    assert found.amplifier_off == [pytest.approx((3.5, 3.5095, 20))]
    figures = found.figures()
    assert (figures["gaps"], figures["saturations"], figures["amplifier_off_in_motion"]) == (1, 1, 1)
    assert (figures["longest_gap_s"], figures["saturated_samples"]) == (pytest.approx(2.5e-3), 11)
    assert json.loads(json.dumps(found.as_json()))["gap_intervals"][0]["samples"] == 4
    # Before the first motion neither, but up to the end of the last one.
    on = np.ones(every.size, bool)
    on[:100] = on[20_000:20_007] = False
    assert assessed(record, amplifier_on=on).amplifier_off == [pytest.approx((10.0, 10.003, 7))]
    # An amplifier that was never on is no fault either.
    assert assessed(record, amplifier_on=np.zeros(every.size, bool)).amplifier_off == []


def test_one_movement_that_does_not_settle_leaves_the_median_of_the_others(make_record, assessed, tmp_path):
    found = assessed(make_record())
    one, never, unknown = (StandstillFigures(settling) for settling in (0.1, math.nan, None))
    text = "settling_median_s: 0.2\nsettling_max_s: 0.2"
    for standstills, median, failed in (([one, one, never], 0.1, 1), ([one, never, never], math.inf, 2)):
        found.standstills = standstills
        figures = found.figures()
        assert (figures["settling_median_s"], figures["settling_max_s"]) == (median, math.inf)
        checks = checked_limits(limits(tmp_path, text), figures)
        assert [check.value for check in checks if not check.passed] == [math.inf] * failed
        assert plain(figures)["settling_max_s"] is None
        assert shown(figures["settling_max_s"]) == "inf"
    found.standstills = [unknown]
    assert [check.value for check in checked_limits(limits(tmp_path, text), found.figures())] == [None, None]


def test_the_figures_are_those_of_the_worst_stroke_of_each_direction(make_record, assessed):
    found = assessed(make_record())
    forward, backward = found.strokes
    one = replace(forward, before_end_points=1.0, after_least_squares=3.0)
    two = replace(forward, before_end_points=0.5, after_least_squares=4.0)
    found.strokes = [one, backward, two]
    figures = found.figures()
    found.strokes = [backward]
    for name, forwards in (("before_end_points", 1e6), ("after_least_squares", 4e6)):
        assert figures[f"straightness_{name}_forward_um"] == forwards
        assert figures[f"straightness_{name}_backward_um"] == getattr(backward, name) * 1e6
        assert found.figures()[f"straightness_{name}_forward_um"] is None


def test_a_sine_in_the_error_shows_in_the_figure_of_its_band_in_micrometres(make_record, motion_profile, assessed):
    record = make_record(1e-6 * np.sin(2 * np.pi * 40 * motion_profile[0]), quantum=1e-9)
    found = assessed(record)
    figures = found.figures()
    assert figures["error_rms_10_100_Hz_um"] == pytest.approx(1 / math.sqrt(2), rel=0.01)
    assert figures["error_rms_0_10_Hz_um"] < 0.02 and figures["error_rms_100_1000_Hz_um"] < 0.02


def test_a_coarse_encoder_that_counts_along_a_smooth_motion_shows_no_stick_slip(make_record, assessed):
    assert assessed(make_record(quantum=2e-6)).stick_slips == []


def test_latency_is_shown_by_percentiles_and_spread_in_microseconds(make_record, assessed):
    latency = np.arange(101) * 1e-6
    figures = assessed(make_record(), latency=latency, lateness=3.0 * latency).figures()
    for name, value in (("p50", 50.0), ("p90", 90.0), ("p99", 99.0), ("max", 100.0)):
        assert (figures[f"latency_{name}_us"], figures[f"lateness_{name}_us"]) == pytest.approx((value, 3.0 * value))
    assert figures["latency_jitter_us"] == pytest.approx(np.std(np.arange(101)))
    without = assessed(make_record(), latency=np.empty(0)).figures()
    assert math.isnan(without["latency_p50_us"]) and math.isnan(without["latency_jitter_us"])


def test_a_band_holds_its_lower_end_and_not_its_upper_one():
    time = np.arange(8192) / 2048.0
    spectrum = error_spectrum(time, 1e-6 * np.sin(2 * np.pi * 100 * time))
    # Of a line's power the Hann window leaves two thirds at its frequency and a sixth 1 Hz to each side.
    for low, high, part in ((100, 101, 4), (99, 100, 1), (101, 102, 1), (99, 102, 6), (102, 1025, 0)):
        assert spectrum.band_rms(low, high) ** 2 == pytest.approx(0.5e-12 * part / 6, abs=1e-20)
    assert len(error_spectrum(time[:15], time[:15]).density) == 0


def limits(tmp_path: Path, text: str) -> Path:
    (tmp_path / "limits.yaml").write_text(text)
    return tmp_path / "limits.yaml"


FIGURES = {"true_pp_um": 0.3, "lost_samples": 2, "latency_p99_us": math.nan, "residual_pp_um": None}


@pytest.mark.parametrize(
    ("text", "failed"),
    [
        ("true_pp_um: 3e-1", []),
        ("lost_samples: {min: 2, max: 2}", []),
        ("true_pp_um: 0.29", ["true_pp_um is 0.3; allowed: <= 0.29"]),
        ("lost_samples: {min: 3, max: 5}", ["lost_samples is 2; allowed: >= 3 and <= 5"]),
        ("latency_p99_us: 500", ["latency_p99_us was not recorded; allowed: <= 500"]),
        ("residual_pp_um: {max: 1}\ntrue_pp_um: 1", ["residual_pp_um was not recorded; allowed: <= 1"]),
    ],
)
def test_limits_judge_figures_and_what_was_not_recorded_fails(tmp_path, text, failed):
    verdicts = checked_limits(limits(tmp_path, text), FIGURES)
    assert [str(verdict) for verdict in verdicts if not verdict.passed] == failed


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("true_pp: 1", "'true_pp' is unknown; did you mean 'true_pp_um'"),
        ("true_pp_um: {maximum: 1}", "allowed: a number, or {min: number, max: number}"),
        ("true_pp_um: yes", "allowed: a number"),
        ("true_pp_um: .nan", "allowed: a number"),
        ("true_pp_um: {min: 2, max: 1}", "min 2 is above max 1"),
        ("", "sets no limit"),
        ("[", "no YAML"),
        ("- 1", "sets no limit"),
    ],
)
def test_limits_that_cannot_be_meant_are_refused(tmp_path, text, reason):
    with pytest.raises(ParameterError, match=re.escape(reason)):
        checked_limits(limits(tmp_path, text), FIGURES)


def test_the_report_needs_no_network_and_has_all_plots(make_record, tmp_path, assessed):
    found = assessed(make_record(), "bag <1>", warnings=("not finished",))
    text = report_html(found, found, checked_limits(limits(tmp_path, "encoder_pp_um: 0.0001"), found.figures()))
    assert text.count('class="plotly-graph-div"') == 6
    # Words with units in place of names with underscores.
    assert not re.search(r">[a-z0-9]+_[a-zA-Z0-9_]+<", text) and "latency p99 / µs" in text
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=", text)
    assert "bag &lt;1&gt;" in text and "bag <1>" not in text
    assert "not finished" in text and "FAILED" in text and "@media print" in text
    assert re.search(r"stage “[^”]+”, [a-z ]+; (began .*)?report by straightcomp_ros .*, 20\d\d-\d\d-\d\d", text)
    assert len(text) < 9e6
