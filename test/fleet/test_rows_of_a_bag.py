"""A row says of a stroke what `straightcomp evaluate` says of it, and what it needs to be found again."""

import math
from dataclasses import replace
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from mcap.writer import Writer
from places import SMC
from recorded_run import recorded_run
from rewritten_bag import rewritten

from straightcomp_ros.analysis.assessment import Assessment
from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.interruption import latched_faults
from straightcomp_ros.fleet.history.strokes_of_bag import binned, date_of_zero, recorded_facts, rows_of
from straightcomp_ros.offline.what_if import what_if
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.safety.faults import LABELLED
from straightcomp_ros.straightness.guide_map import load_map
from straightcomp_ros.timing.node_timing import Report


@pytest.fixture(scope="module")
def evaluation():
    return evaluate_bag(SMC)


@pytest.fixture(scope="module")
def rows(evaluation):
    return rows_of(evaluation, recorded_facts(SMC, "key", evaluation)[1])


def columns_of(evaluation, *names, **changes):
    """These columns of the strokes of a run that was changed."""
    rows = rows_of(replace(evaluation, **changes), {})
    found = [[getattr(row, name) for row in rows] for name in names]
    return found if len(names) > 1 else found[0]


def test_a_row_has_the_figures_that_evaluate_prints_and_names_bag_stage_parameters_and_map(evaluation, rows):
    strokes = Assessment(SMC, evaluation).strokes
    assert len(rows) == len(strokes) == 2
    for row, stroke in zip(rows, strokes, strict=True):
        figures = stroke.to_display()
        del figures["start_s"]
        assert {name: getattr(row, name) for name in figures} == figures
        for one in Assessment(SMC, evaluation).straightness:
            if one["direction"] == row.direction:
                assert getattr(row, f"{one['when']}_{one['line']}_U_um") == one["expanded_uncertainty_um"]
    first = rows[0]
    assert (first.checksum, first.bag, [row.stroke for row in rows]) == ("key", "smc", [1, 2])
    assert first.identity.startswith("synthetic ") and first.law == "smc_observer"
    assert len(first.parameters_checksum) == len(first.map_checksum) == 32
    assert first.parameters_checksum != first.map_checksum
    # The stamps of a simulated run begin one second after the epoch.
    assert first.start == datetime(1970, 1, 1, 0, 0, 1, 203_500, tzinfo=timezone.utc)


def test_parameters_that_have_no_effect_on_a_stroke_do_not_change_their_checksum(evaluation, rows):
    def checksum(node, name, value):
        parameters = {**evaluation.parameters, node: {**evaluation.parameters[node], name: value}}
        return recorded_facts(SMC, "key", replace(evaluation, parameters=parameters))[1]["parameters_checksum"]

    assert checksum("logger", "output", "another folder") == rows[0].parameters_checksum
    assert checksum("controller", "control.law", "linear") != rows[0].parameters_checksum


def test_a_description_that_this_version_cannot_read_has_no_identity(evaluation):
    driver = {**evaluation.parameters["driver"], "stage.platform.colour": "blue"}
    stage, facts = recorded_facts(SMC, "key", replace(evaluation, parameters={"driver": driver}))
    assert facts["identity"] is None and stage == "synthetic"
    assert recorded_facts(SMC, "key", replace(evaluation, parameters={}))[0] == "unknown"


def test_the_latency_of_a_stroke_is_that_of_its_own_samples(evaluation):
    stamps, latency = evaluation.latency_stamps, evaluation.latency
    slow = np.where(stamps < stamps[0] + (stamps[-1] - stamps[0]) // 2, latency, 3e-4)
    assert columns_of(evaluation, "latency_p50_us", latency=slow) == pytest.approx([250.0, 300.0])
    none = {"latency": latency[:0], "latency_stamps": stamps[:0]}
    assert columns_of(evaluation, "latency_p99_us", **none) == [None, None]


def test_lost_and_unanswered_samples_count_in_the_stroke_in_which_they_are_missing(evaluation):
    record, lost, unanswered = evaluation.record, (1000, 1001, 1002), (5000, 5001)
    assert record.time.size == evaluation.stamps.size
    places = np.arange(record.time.size)
    there, kept = ~np.isin(places, lost), ~np.isin(places, (*lost, *unanswered))
    found = columns_of(
        evaluation,
        *("lost_samples", "unanswered_samples", "expected_samples"),
        record=replace(record, **{name: values[kept] for name, values in record.columns().items()}),
        stamps=evaluation.stamps[there],
        amplifier_on=evaluation.amplifier_on[there],
        coil_current=evaluation.coil_current[kept],
    )
    assert found == [[3, 0], [0, 2], [3987, 3987]]


def test_samples_with_the_amplifier_off_or_the_current_at_its_limit_are_counted(evaluation):
    on, current = evaluation.amplifier_on.copy(), evaluation.record.current.copy()
    on[1000:1010] = False
    current[6000:6004] = -0.9
    changes = {"amplifier_on": on, "encoder": evaluation.encoder._replace(off=~on)}
    names = ("amplifier_off_samples", "verdict", "saturated_samples")
    found = columns_of(evaluation, *names, record=replace(evaluation.record, current=current), **changes)
    assert found == [[10, 0], ["interrupted", "in_order"], [0, 4]]


def test_a_fault_belongs_to_the_stroke_in_which_it_was_latched_or_after_which(evaluation):
    begin, labels = evaluation.begin_ns, sorted(LABELLED)[:2]
    reports = [
        Report(begin + 1_000_000_000, {"error": f"{labels[0]}: the first"}),
        Report(begin + 2_250_000_000, {"error": f"{labels[1]}: between the strokes"}),
        Report(begin + 2_260_000_000, {"error": f"{labels[1]}: still"}),
        Report(begin + 3_000_000_000, {}),
    ]
    faults = latched_faults({"driver": reports}, begin)
    assert columns_of(evaluation, "faults", "verdict", faults=faults) == [[labels, []], ["interrupted", "in_order"]]


def test_the_verdict_is_that_on_the_stroke_alone(evaluation):
    record = evaluation.record
    wave = np.where(record.time > 2.25, 5e-6 * np.sin(2.0 * math.pi * 112.0 * record.time), 0.0)
    shaken = replace(record, y=record.y + wave, true_y=record.true_y + wave)
    verdicts, reasons = columns_of(evaluation, "verdict", "reason", record=shaken)
    assert verdicts == ["in_order", "oscillates"] and "112 Hz" in reasons[1]


def test_bins_have_the_same_edges_in_all_strokes_and_the_mean_of_the_samples_within_them(evaluation, rows):
    record, row = evaluation.record, rows[0]
    assert [row.bins_from_mm for row in rows] == [0, 0]
    assert all(len(row.error_bins_um) == len(row.residual_bins_um) == len(row.current_bins_A) == 20 for row in rows)
    inside = (record.time > 0.2) & (record.time < 2.2) & (record.x >= 0.05) & (record.x < 0.06)
    assert row.error_bins_um[5] == pytest.approx(float((record.r - record.y)[inside].mean()) * 1e6)
    assert row.current_bins_A[5] == pytest.approx(float(record.current[inside].mean()))


@pytest.mark.parametrize(
    ("low", "high", "first", "count"),
    [
        (0.0, 0.2, 0, 20),
        (-1e-7, 0.2, 0, 20),
        (0.0, 0.2001, 0, 20),
        (-0.02, 0.016, -20, 4),
        (0.006, 0.031, 10, 2),
        (0.001, 0.004, 0, 0),
    ],
)
def test_only_bins_that_a_stroke_covers_by_half_count(low, high, first, count):
    x = np.linspace(low, high, 10_001)
    bins, edges = binned(x, {"means": x}), first * 1e-3 + 0.01 * np.arange(count + 1)
    means = bins["means"]
    assert len(means) == count and (bins["bins_from_mm"] == first or not count)
    assert (edges[:-1] <= means).all() and (means <= edges[1:]).all()


def test_a_bin_without_a_sample_is_null_and_not_zero():
    x = np.concatenate([np.linspace(0.0, 0.01, 50, endpoint=False), np.linspace(0.02, 0.03, 50)])
    assert binned(x, {"ones": np.ones(100)})["ones"] == [1.0, None, 1.0]


BUMP_UM = 0.8


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """A run through a coarse converter, steps of 8 mA, with a displacement sensor over a bump of the guide."""
    values = shipped_parameters()
    values["stage"] |= {"motion.stroke": 0.2, "motion.settle": 0.1, "motion.pause": 0.1, "drive.dac_bits": 8}
    guide = load_map()

    def reading(sample, truth):
        # The zero of the sensor is arbitrary.
        bumpy = 5e-6 + guide.deviations(truth.x) + BUMP_UM * 1e-6 * (0.05 < truth.x < 0.07)
        return bumpy if sample.stamp_ns % 5_000_000 == 0 else None

    return evaluate_bag(recorded_run(tmp_path_factory.mktemp("run") / "bag", values, sensor=reading))


def test_a_guide_that_is_not_the_map_s_is_judged_by_the_sensor_where_there_is_no_truth(evaluation, monkeypatch):
    record = evaluation.record
    seen = replace(record, true_x=None, true_y=None, guide=None)
    turned = replace(evaluation, record=seen, guide=-record.guide)
    monkeypatch.setattr("straightcomp_ros.offline.what_if.evaluate_bag", lambda *_: turned)
    assert what_if(SMC, {})[0].verdict.verdict == "wrong_guide"
    assert columns_of(turned, "verdict") == ["wrong_guide"] * 2
    assert columns_of(turned, "verdict", guide=record.guide) == ["in_order"] * 2


def test_the_bandwidth_comes_from_commands_as_the_converter_of_that_bag_rounded_them(coarse):
    right = pytest.approx([500.0, 500.0], rel=0.02)
    driver = {**coarse.parameters["driver"], "stage.drive.dac_bits": 12}
    another = {**coarse.parameters, "driver": driver}
    assert columns_of(coarse, "amplifier_bandwidth_Hz") == right
    assert columns_of(coarse, "amplifier_bandwidth_Hz", parameters=another) != right


def test_the_guide_has_changed_where_the_sensor_saw_it(coarse):
    rows = rows_of(coarse, {})
    assert [row.direction for row in rows] == ["forward", "backward"]
    for row in rows:
        middles = row.bins_from_mm + 10.0 * (np.arange(len(row.guide_change_um)) + 0.5)
        change = np.array(row.guide_change_um, np.float64)
        inside = (middles > 50) & (middles < 70)
        assert np.allclose(change[inside] - np.median(change), BUMP_UM, atol=0.05)
        assert np.abs(change[~inside] - np.median(change)).max() < 0.05


def test_a_sensor_of_too_few_readings_does_not_judge_the_guide_by_what_lies_between_them(coarse):
    assert set(np.diff(np.flatnonzero(np.isfinite(coarse.readings)))) == {10} and np.isfinite(coarse.guide[:-10]).all()
    seen = {"record": replace(coarse.record, true_x=None, true_y=None, guide=None)}
    assert columns_of(coarse, "verdict", **seen, read=True) == ["wrong_guide"] * 2
    assert "wrong_guide" not in columns_of(coarse, "verdict", **seen)


def test_strokes_in_simulated_time_have_the_date_at_which_their_bag_was_made(evaluation, rows):
    zero = date_of_zero(SMC, evaluation.begin_ns)
    dated = rows_of(evaluation, recorded_facts(SMC, "key", evaluation)[1], zero)
    assert [one.start - zero for one in dated] == [one.start for one in rows]
    assert dated[0].start.year == 2026 and date_of_zero(SMC, 1_700_000_000_000_000_000) == timedelta(0)


def test_an_attachment_without_a_time_of_creation_dates_a_simulated_run_by_its_record(tmp_path):
    with (tmp_path / "one.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.add_attachment(0, 2_000_000_000, "notes.txt", "text/plain", b"")
        writer.finish()
    assert date_of_zero(tmp_path / "one.mcap", 500_000_000) == timedelta(seconds=1.5)


def test_a_clock_that_was_set_between_two_strokes_gives_each_its_own_date(tmp_path, rows):
    def change(topic, stamp, numbers):
        stamp += 1_790_000_000_000_000_000 if stamp >= 2_250_000_000 else 0
        return stamp, numbers, stamp

    bag = rewritten(SMC, tmp_path / "run", change)
    with pytest.warns(UserWarning, match="the recording was paused"):
        evaluation = evaluate_bag(bag)
    found = rows_of(evaluation, {}, date_of_zero(bag, evaluation.begin_ns))
    assert [one.start.strftime("%Y-%m") for one in found] == ["2026-11", "2026-09"]
    for name in ("verdict", "encoder_pp_um", "lost_samples", "latency_p50_us"):
        assert [getattr(one, name) for one in found] == [getattr(one, name) for one in rows]
