"""A certificate is written for what was measured within its limits, and for nothing else."""

import dataclasses
import hashlib
import json
import math
import re
import shutil
from typing import Any

import pytest
from roughly_known import values_of, work_on

from straightcomp_ros.analysis.straightness_statement import Contribution, Statement, with_uncertainty
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.tuning.commissioning import STEP_FILES
from straightcomp_ros.tuning.commissioning.certificate import certificate
from straightcomp_ros.tuning.commissioning.machine import Outcome

ENCODER, SURVEY = Contribution("encoder", 29e-9, 5e-9, -90e-9), Contribution("map", 10e-9, 12e-9, 1e-9)
LATENCY = {"p50": 335.12100000000004, "p99": 335.12100000000004, "p99.9": 335.2, "p100": 335.2}
TIMING = {
    "latency_us": LATENCY,
    "due_us": 335.121,
    "in_time_pp_um": 0.2,
    "as_measured_costs_um": 0.0,
    "p99_costs_um": 0.0,
    "stall_error_um": {"1 ms": 0.12, "100 ms": math.inf},
    "amplifier_off_after_ms": 250.0,
    "longest_stall_survived_ms": 50,
}
NONE_LOST = {"lost_samples": 0, "lost_commands": 0}
MARGINS = {"gain_low": 0.25, "gain_high": 2.5, "phase_deg": 45.0}
SHOWN = {"rate_Hz": 199.5, "clock_drift_ppm": 12.5, "jitter_us": 3.25, "count_y_nm": 100.5}
SHOWN |= {"noise_y_counts": 0.375, "noise_x_counts": 0.125}
ACCEPTED = {"encoder_pp_um": 0.4, "encoder_rms_um": 0.064, "control_rms_step_A": 0.00137}
ACCEPTED |= {"samples": 30000, "straightness": []}
LIMITS = {"encoder_pp_um": 0.6, "encoder_rms_um": 0.096, "control_rms_step_A": 0.00206}
FIGURES: dict[str, dict[str, Any]] = {
    "connection": {**NONE_LOST, **SHOWN, "latency_us": LATENCY, "latency_histogram": [[355.3, 60000]]},
    "signs_and_scales": {"readback_gain": 1.0125, "readback_offset_A": 0.0015},
    "identification": {"parameters": {}, "not_identifiable": ["Forces have no scale of their own.", "Friction < 2 N."]},
    "design": {"budget": [{"cause": "as described", "pp_um": 0.19, "rms_um": 0.036}]},
    "frequency_response": {"margins": MARGINS, "model_margins": {}},
    "acceptance": {**ACCEPTED, **NONE_LOST, "lost_commands": 3, "timing": TIMING, "limits": LIMITS},
}


def done(folder, **changed):
    """Steps that have passed with these figures."""
    outcomes = {
        name: Outcome(True, f"{name} is good", {**figures, **changed.get(name, {})})
        for name, figures in FIGURES.items()
    }
    return dataclasses.replace(work_on(values_of(), folder), outcomes=outcomes)


def written(folder):
    """The page, and the content of the JSON beside it."""
    return (folder / "certificate.html").read_text(), json.loads((folder / "certificate.json").read_text())


@pytest.mark.parametrize(
    ("step", "changed", "words"),
    [
        ("connection", {"lost_samples": 2}, "lost samples, amplifier off 2 (allowed: <= 0)"),
        ("frequency_response", {"margins": {**MARGINS, "gain_low": 0.8}}, "0.7692"),
        ("frequency_response", {"margins": {**MARGINS, "phase_deg": 9.99}}, ">= 10"),
        ("acceptance", {"lost_samples": 1}, "lost samples of the stroke 1 (allowed: <= 0)"),
        ("acceptance", {"lost_commands": 151}, "samples of the stroke without a command 151 (allowed: <= 150)"),
        ("acceptance", {"timing": {**TIMING, "as_measured_costs_um": 0.25}}, "cost [µm p-p] 0.25 (allowed: <= 0.2)"),
        ("acceptance", {"timing": {**TIMING, "as_measured_costs_um": math.inf}}, "infinite, since the platform is"),
        # As a record has it that was read again.
        ("acceptance", {"timing": {**TIMING, "as_measured_costs_um": None}}, "infinite, since the platform is lost"),
    ],
)
def test_a_figure_beyond_its_limit_is_named_and_nothing_is_written(tmp_path, step, changed, words):
    outcome = certificate(done(tmp_path, **{step: changed}))
    assert not outcome.passed
    assert outcome.sentence.startswith("beyond the limits: ") and words in outcome.sentence
    assert f"repeat the step (--only {step})" in outcome.sentence
    assert not any((tmp_path / name).exists() for name in STEP_FILES["certificate"])


@pytest.mark.parametrize(
    "changed",
    [
        {"timing": {**TIMING, "latency_us": {**LATENCY, "p99": 960.0}, "p99_costs_um": 0.5}},
        {"timing": {**TIMING, "as_measured_costs_um": 0.2 * (1.0 + 1e-12)}},
        {"timing": {**TIMING, "in_time_pp_um": 0.05, "as_measured_costs_um": 0.1}},
        {"timing": {name: one for name, one in TIMING.items() if not name.endswith("costs_um")}},
        {"lost_commands": 150},
    ],
    ids=["a late p99 that costs nothing", "the last bits of a limit", "a count", "no latencies", "one command in 200"],
)
def test_lateness_is_judged_by_what_it_costs(tmp_path, changed):
    outcome = certificate(done(tmp_path, acceptance=changed))
    assert outcome.passed, outcome.sentence


def test_the_page_and_the_json_have_what_was_found_and_limits_of_later_strokes_are_no_checks_of_this_one(tmp_path):
    outcome = certificate(done(tmp_path))
    assert outcome.passed, outcome.sentence
    page, content = written(tmp_path)
    assert all(check["passed"] for check in content["checks"]) and ">passed<" in page and "FAILED" not in page
    assert not {one["name"] for one in content["checks"]} & set(LIMITS)
    assert content["later_limits"][0] == {"name": "encoder_pp_um", "value": 0.4, "limit": 0.6}
    assert "Limits for later strokes" in page
    sentences = ("Forces have no scale of their own.", "Friction &lt; 2 N.")
    for figure in (*map(str, SHOWN.values()), "1.012", "1.5", *sentences):
        assert f">{figure}<" in page, figure
    # Half to twice the described amplifier of 500 Hz, and 0.6 to 1.4 samples of 500 µs.
    assert "250 to 1000" in page and "300 to 700" in page
    assert "0.02 µm RMS" in page, "the survey's own error"
    assert re.search(r">100 ms</td>\s*<td[^>]*>lost<", page) and "None" not in page


def test_the_page_states_the_straightness_with_its_uncertainty_and_what_that_is_made_of(tmp_path):
    unknown = Contribution("repeatability", None, counts=False)
    before = Statement("before", "forward", "end_points", 1, 22.4e-6, (SURVEY,))
    after = Statement("after", "forward", "minimum_zone", 1, 0.2e-6, (unknown, ENCODER, SURVEY))
    stated = [one.to_display() for one in (before, after)]
    assert certificate(done(tmp_path, acceptance={"straightness": stated})).passed
    page, content = written(tmp_path)
    cells = re.findall(r"<td[^>]*>([^<]*)<", page[page.index("after, forward, minimum zone") - 10 :])[:7]
    # 2 √(5² + 12²) nm.
    assert cells == ["after, forward, minimum zone", "0.200", "0.111", "0.026", "?", "0.005", "0.012"]
    assert "before, forward, end points" in page and "None" not in page
    assert content["steps"]["acceptance"]["figures"]["straightness"] == stated


@pytest.mark.parametrize(
    ("require", "passed", "words"),
    [
        (None, True, "Passed: every figure is within its limits; {}; no "),
        (0.5, True, "Passed: {}, required: at most 0.5 µm; 0.36 µm to "),
        (0.12, False, "Not passed: {}, required: at most 0.12 µm; 0.017"),
    ],
)
def test_the_first_line_says_whether_the_tolerance_is_kept_with_the_uncertainty_and_for_which_machine(
    tmp_path, require, passed, words
):
    stated = [Statement("after", way, "minimum_zone", 1, 0.2e-6, (ENCODER, SURVEY)) for way in ("forward", "backward")]
    budget = [("as described", 0.131, 0.02), ("ideal encoder", 0.1, 0.02), ("a hundredth of the friction", 0.491, 0.04)]
    work = done(
        tmp_path,
        acceptance={"straightness": [one.to_display() for one in stated]},
        design={"budget": [{"cause": name, "pp_um": pp, "rms_um": rms} for name, pp, rms in budget]},
    )
    work.values["stage"]["serial"] = "A 17"
    outcome = certificate(dataclasses.replace(work, require=require))
    page, content = written(tmp_path)
    assert outcome.passed == content["passed"] == passed and outcome.sentence.startswith(content["conclusion"])
    stated = "straightness after compensation (0.111 ± 0.026) µm"
    assert content["conclusion"].startswith(words.format(stated)) and content["machine"] == "simulated"
    first = re.sub("<[^>]*>", " ", page[page.index("</h1>") : page.index("<section>")])
    assert content["conclusion"] in first and "Simulated machine" in first and "serial number A 17, law" in first
    assert "“a hundredth of the friction” would leave more: 0.49 µm p-p instead of 0.13" in page
    assert "“ideal encoder”" not in page


@pytest.mark.parametrize("require", [None, 0.5])
def test_a_straightness_whose_uncertainty_is_not_known_is_not_stated_and_keeps_no_tolerance(tmp_path, require):
    nothing = (Contribution("map", None),)
    stated = [
        Statement(when, way, "minimum_zone", 1, 0.2e-6, nothing if when == "after" or way == "forward" else (SURVEY,))
        for when in ("before", "after")
        for way in ("forward", "backward")
    ]
    work = done(tmp_path, acceptance={"straightness": [one.to_display() for one in stated]})
    outcome = certificate(dataclasses.replace(work, require=require))
    _, content = written(tmp_path)
    assert outcome.passed == (require is None) and "uncertainty is not known" in outcome.sentence
    assert {when: one["direction"] for when, one in content["straightness"].items()} == {"before": "backward"}


@pytest.mark.parametrize("where", ["the package", "home"])
def test_the_certificate_has_the_checksum_of_the_map_wherever_it_was_found(tmp_path, monkeypatch, where):
    name, survey = "config/survey_synthetic.csv", share_path("config/survey_synthetic.csv")
    monkeypatch.chdir(tmp_path)
    if where == "home":
        monkeypatch.setenv("HOME", str(tmp_path))
        name, survey = "~/mine.csv", shutil.copy(survey, tmp_path / "mine.csv")
    assert certificate(done(tmp_path).given("stage", {"guide.file": name})).passed
    digests = written(tmp_path)[1]["sha256"]
    assert digests[f"map {survey.name}"] == hashlib.sha256(survey.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("value", "expanded", "text"),
    [(22.4012, 0.0236, "(22.401 ± 0.024) µm"), (0.2, 0.0996, "(0.20 ± 0.10) µm"), (312.4, 25.0, "(312 ± 25) µm")],
)
def test_a_value_has_the_digits_of_its_uncertainty(value, expanded, text):
    assert with_uncertainty(value, expanded) == text
