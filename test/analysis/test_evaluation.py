"""A bag's streams put together by their stamps: the run, its counts, its delays."""

import math

import numpy as np
import pytest
from bag_of_rows import REPORT, bag_of, bag_of_rows, packed, report

from straightcomp_ros.analysis import evaluation
from straightcomp_ros.analysis.evaluation import evaluate_bag, percentile_us
from straightcomp_ros.analysis.record import runs_of
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.contract import COMMAND, DIAGNOSTICS, DISPLACEMENT, DRIVER_STATE, ENCODER, REFERENCE, TRUTH

START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 500_000
COUNT = 40


def sample(number):
    """What each stream says of the sample ``number``; every value identifies its sample."""
    on = number >= 10
    return {
        ENCODER: (0.01 * number, 1e-6 * number, math.nan, 0.1 * number if on else math.nan),
        REFERENCE: (2e-6 * number, 0.0, 0.0),
        COMMAND: (0.2 * number,),
        DRIVER_STATE: (1e-4 * number if number % 2 else math.nan, 1e-5 * number, 0.0, float(on)),
        TRUTH: (0.01 * number + 1e-9, 1e-6 * number + 1e-9, 0.0, 0.0, 0.0, 3e-6 * number),
    }


def rows_of(without=(), left_out=None, drift=0.0, again=(), order=range(COUNT)):
    """COUNT samples; ``left_out`` gives for a stream the samples that it lacks."""
    return (
        (stream, START_NS + round(number * PERIOD_NS * (1.0 + drift)), numbers)
        for number in [*order, *again]
        for stream, numbers in sample(number).items()
        if stream not in without and number not in (left_out or {}).get(stream, ())
    )


def recorded(path, rate=None, **changes):
    """A bag of the samples, as of :func:`rows_of`."""
    parameters = "" if rate is None else f"/driver: {{ros__parameters: {{stage.rate: {rate}}}}}"
    return bag_of_rows(path, rows_of(**changes), parameters)


def test_the_run_begins_when_the_amplifier_is_switched_on_and_has_every_stream(tmp_path):
    found = evaluate_bag(recorded(tmp_path / "bag"))
    numbers = np.arange(10, COUNT)
    record = found.record
    assert record.time == pytest.approx((numbers - 10) * 5e-4, abs=1e-12)
    assert record.x == pytest.approx(0.01 * numbers) and record.y == pytest.approx(1e-6 * numbers)
    assert record.r == pytest.approx(2e-6 * numbers) and record.current == pytest.approx(0.2 * numbers)
    assert record.true_x == pytest.approx(0.01 * numbers + 1e-9, abs=1e-12)
    assert record.true_y == pytest.approx(1e-6 * numbers + 1e-9, abs=1e-12)
    assert record.guide == pytest.approx(3e-6 * numbers) and record.law == "unknown"
    assert (found.expected_samples, found.received_samples, found.lost_samples) == (30, 30, 0)
    assert (found.lost_references, found.lost_commands) == (0, 0)
    assert found.amplifier_on.all() and len(found.stamps) == 30 and found.parameters == {}
    assert found.latency == pytest.approx(1e-4 * np.arange(1, COUNT, 2))
    assert found.lateness == pytest.approx(1e-5 * np.arange(COUNT))
    assert [percentile_us(found.latency, percent) for percent in (0, 100)] == pytest.approx([100.0, 3900.0])


def test_without_truth_delays_or_an_amplifier_that_is_on_the_bag_is_a_run_all_the_same(tmp_path):
    found = evaluate_bag(recorded(tmp_path / "bag", without=(TRUTH, DRIVER_STATE)))
    assert found.record.true_x is found.record.true_y is found.record.guide is None
    assert len(found.record.x) == 30
    assert len(found.latency) == len(found.lateness) == 0 and math.isnan(percentile_us(found.latency, 50))
    found = evaluate_bag(recorded(tmp_path / "off", order=range(10)))
    assert len(found.record.x) == 10 and not found.amplifier_on.any()


def test_a_stage_that_stands_has_a_record_too(tmp_path):
    rows = [(stream, START_NS + n * PERIOD_NS, sample(20)[stream]) for n in range(COUNT) for stream in sample(20)]
    assert np.ptp(evaluate_bag(bag_of_rows(tmp_path / "bag", rows)).record.x) == 0.0


def test_what_is_missing_of_each_stream_is_counted_up_to_its_last(tmp_path):
    left_out = {REFERENCE: {12, 20, 38, 39}, COMMAND: {12, 15, 16, 39}, ENCODER: {25, 30}, TRUTH: {33}}
    found = evaluate_bag(recorded(tmp_path / "bag", left_out=left_out))
    assert (found.expected_samples, found.received_samples, found.lost_samples) == (30, 28, 2)
    # After the last reference, or command, the recording simply ended.
    assert (found.lost_references, found.lost_commands) == (2, 3)
    assert len(found.record.x) == 30 - len({12, 20, 38, 39, 15, 16, 25, 30, 33})
    assert len(found.stamps) == 28


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
def test_samples_are_counted_by_the_boards_own_clock(tmp_path, drift):
    left_out = {stream: set(range(14, 37, 3)) for stream in sample(0)}
    found = evaluate_bag(recorded(tmp_path / "bag", left_out=left_out, drift=drift))
    assert (found.expected_samples, found.lost_samples) == (30, 8)


def test_samples_at_another_rate_than_the_parameters_of_their_run_are_said_to_be(tmp_path):
    evaluate_bag(recorded(tmp_path / "bag", rate=2000, drift=0.001))
    with pytest.warns(UserWarning, match=r"2000 times a second.*'stage\.rate' says 4000 Hz"):
        evaluate_bag(recorded(tmp_path / "other", rate=4000))


@pytest.mark.parametrize("rate", ["fast", "[1, 2]", "", ".nan", "true"])
def test_recorded_parameters_that_are_no_numbers_refuse_the_bag(tmp_path, rate):
    with pytest.raises(BagError, match=r"'stage\.rate' of node 'driver' is .*; allowed: a finite number"):
        evaluate_bag(recorded(tmp_path / "bag", rate=rate))


def test_of_rests_between_strokes_only_that_in_which_the_recording_paused_is_not_judged(motion_profile):
    time, x = motion_profile
    stamps = np.append(time, time + time[-1] + 3600.0) * 1e9
    judged = evaluation._judged(stamps.astype(np.int64), np.append(x, x))
    # From the stroke before the pause to the one behind it, at rest for 0.25 s on each side.
    ((begin, end),) = runs_of(~judged)
    assert (begin, end) == pytest.approx((time.size - 500, time.size + 500), abs=20)


def test_samples_that_come_twice_or_in_disorder_count_once(tmp_path):
    shuffled = np.random.default_rng(1).permutation(COUNT).tolist()
    found = evaluate_bag(recorded(tmp_path / "bag", order=shuffled, again=(20, 21)))
    assert (found.expected_samples, found.received_samples) == (30, 30)
    assert found.record.x == pytest.approx(0.01 * np.arange(10, COUNT))


@pytest.mark.parametrize("stream", [ENCODER, REFERENCE, COMMAND])
def test_a_bag_that_lacks_a_stream_is_refused_with_its_name(tmp_path, stream):
    with pytest.raises(BagError, match=f"no messages on '{stream.topic}'; was the whole graph running"):
        evaluate_bag(recorded(tmp_path / "none", without=(stream,)))
    with pytest.raises(BagError, match=f"no messages on '{stream.topic}'"):
        evaluate_bag(recorded(tmp_path / "one", left_out={stream: set(range(COUNT - 1))}))


def test_streams_that_belong_to_different_runs_are_refused(tmp_path):
    left_out = {COMMAND: set(range(20)), REFERENCE: set(range(21, COUNT))}
    with pytest.raises(BagError, match="no common stamps"):
        evaluate_bag(recorded(tmp_path / "bag", left_out=left_out))


@pytest.mark.parametrize("in_each", [False, True], ids=["now", "in 0.1"])
def test_faults_are_those_that_nodes_in_the_namespace_of_the_encoder_report(tmp_path, in_each):
    samples = [(f"/line_3{topic}", *message) for topic, *message in packed(rows_of())]
    end, reports = START_NS + COUNT * PERIOD_NS, []
    for line in ("line_3", "line_4"):
        data = report(f"{line}/driver", end, error=f"tripped: by {line}/driver")
        reports.append((f"/{line}{DIAGNOSTICS}" if in_each else DIAGNOSTICS, REPORT, data, end, end))
    found = evaluate_bag(bag_of(tmp_path / "bag", samples + reports))
    assert [fault.reason for fault in found.faults] == ["by line_3/driver"]
    assert found.reports == read_reports(tmp_path / "bag")


def in_namespaces(path, *stages):
    """A bag of stages, each of a namespace and its rows."""
    return bag_of(path, [(f"{space}{topic}", *one) for space, rows in stages for topic, *one in packed(rows)])


@pytest.mark.parametrize(("first", "remap"), [("", {}), ("/a", {ENCODER.topic: "/a/encoder"})])
@pytest.mark.parametrize("later", [0, 10**12])
def test_of_two_stages_in_a_bag_that_of_the_encoder_is_judged_by_its_own_streams(tmp_path, first, remap, later):
    sensor = [(DISPLACEMENT, START_NS + number * PERIOD_NS, (1e-6 * number,)) for number in range(COUNT)]
    other = [(stream, stamp + later, numbers) for stream, stamp, numbers in [*rows_of(), *sensor]]
    both = ((first, rows_of(without=(TRUTH, DRIVER_STATE))), ("/b", other))
    bag = in_namespaces(tmp_path / "bag", *both)
    found = evaluate_bag(bag, remap)
    assert (found.begin_ns, len(found.record.x)) == (START_NS + 10 * PERIOD_NS, 30)
    assert (found.record.true_x, found.guide, len(found.latency)) == (None, None, 0)
    found = evaluate_bag(bag, {ENCODER.topic: "/b/encoder"})
    assert (found.begin_ns, len(found.record.true_x)) == (START_NS + 10 * PERIOD_NS + later, 30)
    assert found.guide is not None and len(found.latency) == COUNT // 2


def test_a_stage_without_commands_is_not_judged_by_those_of_another(tmp_path):
    bag = in_namespaces(tmp_path / "bag", ("/a", rows_of(without=(REFERENCE, COMMAND, TRUTH))), ("/b", rows_of()))
    with pytest.raises(BagError, match="has no messages on 'reference'"):
        evaluate_bag(bag, {ENCODER.topic: "/a/encoder"})


def test_an_encoder_alone_in_its_namespace_is_judged_with_all_the_streams_of_the_stage(tmp_path):
    filtered = rows_of(without=(REFERENCE, COMMAND, DRIVER_STATE, TRUTH))
    bag = in_namespaces(tmp_path / "bag", ("", rows_of()), ("/filtered", filtered))
    found = evaluate_bag(bag, {ENCODER.topic: "/filtered/encoder"})
    assert len(found.record.true_x) == 30 and len(found.latency) == COUNT // 2
