"""A bag's streams put together by their stamps: the run, its counts, its delays."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from bag_of_rows import REPORT, bag_of, bag_of_rows, packed, report

from straightcomp_ros.analysis import evaluation
from straightcomp_ros.analysis.evaluation import FOR_EVER, evaluate_bag, percentile_us, samples_between, samples_taken
from straightcomp_ros.analysis.record import MetricsError, runs_of
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import StreamColumns
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


def test_faults_are_those_that_nodes_in_the_namespace_of_the_encoder_report(tmp_path):
    samples = [(f"/line_3{topic}", *message) for topic, *message in packed(rows_of())]
    end, reports = START_NS + COUNT * PERIOD_NS, []
    for line in ("line_3", "line_4"):
        data = report(f"{line}/driver", end, error=f"tripped: by {line}/driver")
        reports.append((DIAGNOSTICS, REPORT, data, end, end))
    found = evaluate_bag(bag_of(tmp_path / "bag", samples + reports))
    assert [fault.reason for fault in found.faults] == ["by line_3/driver"]
    assert found.reports == read_reports(tmp_path / "bag")


@pytest.mark.parametrize(("first", "remap"), [("", {}), ("/a", {ENCODER.topic: "/a/encoder"})])
@pytest.mark.parametrize("later", [0, 10**12])
def test_of_two_stages_in_a_bag_that_of_the_encoder_is_judged_by_its_own_streams(tmp_path, first, remap, later):
    sensor = [(DISPLACEMENT, START_NS + number * PERIOD_NS, (1e-6 * number,)) for number in range(COUNT)]
    other = [(stream, stamp + later, numbers) for stream, stamp, numbers in [*rows_of(), *sensor]]
    both = ((first, rows_of(without=(TRUTH, DRIVER_STATE))), ("/b", other))
    bag = bag_of(tmp_path / "bag", [(f"{space}{topic}", *one) for space, rows in both for topic, *one in packed(rows)])
    found = evaluate_bag(bag, remap)
    assert (found.begin_ns, len(found.record.x)) == (START_NS + 10 * PERIOD_NS, 30)
    assert (found.record.true_x, found.guide, len(found.latency)) == (None, None, 0)
    found = evaluate_bag(bag, {ENCODER.topic: "/b/encoder"})
    assert (found.begin_ns, len(found.record.true_x)) == (START_NS + 10 * PERIOD_NS + later, 30)
    assert found.guide is not None and len(found.latency) == COUNT // 2


PERIOD = PERIOD_NS * 1e-9
JITTER = np.random.default_rng(1).integers(-PERIOD_NS // 5, PERIOD_NS // 5, 4000)
JITTERED = START_NS + PERIOD_NS * np.arange(4000) + JITTER


def test_samples_are_counted_from_one_to_the_next_and_not_in_pauses():
    period = np.median(np.diff(JITTERED))
    stamps = np.delete(JITTERED, [5, 6, 7, *range(100, 2900)])
    expected = [max(1, round(float(step / period))) for step in np.diff(stamps)]
    assert samples_between(stamps, JITTERED).tolist() == expected
    even = stamps - np.delete(JITTER, [5, 6, 7, *range(100, 2900)])
    assert (samples_taken(even), samples_taken(even, even[[96]])) == (4000, 4000 - 2800)
    # Two samples of one batch are two, however near.
    assert samples_between(np.array([0, 1, PERIOD_NS]), JITTERED).tolist() == [1, 1]


def part_of(record, kept):
    return replace(record, **{name: values[kept] for name, values in record.columns().items()})


def test_the_stamps_of_the_record_are_those_of_its_samples_after_months_too(make_record, assessed):
    record = make_record()
    stamps = START_NS + np.round(record.time * 1e9).astype(np.int64) + np.resize(JITTER, record.time.size)
    kept = np.flatnonzero(np.random.default_rng(2).uniform(size=stamps.size) < 0.7)
    late = stamps + np.where(np.arange(stamps.size) > 2000, 200 * 86_400 * 10**9, 0)
    time = (late[kept] - late[kept[0]]) * 1e-9
    found = replace(
        assessed(record).evaluation,
        record=replace(part_of(record, kept), time=time),
        stamps=late,
        begin_ns=late[kept[0]],
    )
    assert (found.record_stamps == late[kept]).all()


def test_the_part_of_the_travel_that_is_in_the_record_is_what_its_samples_leave_no_gap_in(make_record, assessed):
    record = make_record()
    size, whole = record.time.size, assessed(record).evaluation
    numbers, middle = np.arange(size), size // 2
    assert whole.partial() is None
    for thinned, share in (
        (numbers % 3 == 0, "33% of the travel"),
        ((numbers % 5 == 0) | (numbers > middle), None),
        ((numbers % 5 == 0) | (numbers < middle), None),
        ((numbers % 20 == 0) | (numbers > 1.2 * middle), "4[0-9]% of the travel"),
    ):
        found = replace(whole, record=part_of(record, thinned), begin_ns=int(whole.stamps[thinned.argmax()])).partial()
        assert (found is None) == (share is None)
        if share:
            assert found.verdict == "starved" and re.search(share, found.reason)


def test_an_error_of_samples_outside_the_record_harms_from_twice_the_usual_one_and_more_than_a_count_on(
    make_record, assessed
):
    record = make_record()
    usual = 1e-6 * np.sin(40.0 * record.time)
    first, _ = assessed(record).evaluation.encoder.strokes
    middle = (first.start + first.stop) // 2
    missing = np.isin(np.arange(usual.size), range(middle, middle + 50))

    def found(error, missing=missing, **changes):
        run = replace(assessed(record).evaluation, record=part_of(record, ~missing), seen_error=error, **changes)
        return run.partial()

    peak = float(usual[first.samples].min())
    for pp, harm in ((2.2e-6, False), (3.8e-6, False), (4.2e-6, True)):
        error = np.where(missing, peak + pp, usual)
        verdict = found(error)
        assert (verdict is not None) == harm
    assert verdict.verdict == "starved"
    assert f"50 samples of the motion, from {record.time[middle]:.2f}" in verdict.reason
    assert "4.2 µm p-p in place of 2;" in verdict.reason
    # Of samples at rest, after the last one that was judged, without a known reference, or within a count: none.
    resting = np.isin(np.arange(usual.size), range(first.stop + 100, first.stop + 150))
    assert found(np.where(resting, 9e-6, usual), resting) is None
    run = assessed(record).evaluation.encoder
    assert found(np.where(missing, np.nan, usual)) is found(np.empty(0)) is None
    assert found(np.where(missing, 0.06e-6, 0.01 * usual)) is None
    assert found(np.where(missing, 0.2e-6, 0.01 * usual)) is not None
    # Nor for another time of the run.
    whole = replace(assessed(record).evaluation, record=part_of(record, ~missing), seen_error=error)
    ended = replace(whole, encoder=run._replace(judged_ns=int(run.stamps[middle])))
    assert ended._unjudged_harm(0, FOR_EVER) == ""
    assert whole.partial(int(run.stamps[first.stop])) is None
    assert whole.partial(0, int(run.stamps[middle])) is None is not whole.partial(1)


def test_what_is_known_to_break_a_run_is_its_verdict_and_said_of_a_stage_that_stands(make_record, assessed):
    record = make_record()
    for changes in ({"lost_files": "run_1.mcap"}, {"clock_jump": "the clock jumps"}):
        found = assessed(record, **changes)
        assert found.verdict == found.partial != assessed(record).verdict
        with pytest.raises(MetricsError, match=f"{next(iter(changes.values()))}.*; while the law ran: .*move"):
            assessed(replace(record, x=0.0 * record.x), **changes)
    with pytest.raises(MetricsError, match=r"^(?!.*while the law ran).*move"):
        assessed(replace(record, x=0.0 * record.x))


def test_a_reference_that_was_not_recorded_is_the_maps_or_that_of_the_same_place(make_record, cosine_map):
    record = make_record(truth=False)
    stamps = np.round(record.time * 1e9).astype(np.int64)
    kept = np.arange(stamps.size) % 4 != 0
    stream = StreamColumns(stamps[kept], stamps[kept], {"r": record.r[kept] + 1e-3})
    inside = ~kept & (record.x > record.x.min()) & (record.x < record.x.max())
    by_map, by_place = (
        evaluation._reference_at(stamps, record.x, stream, record, known) for known in (cosine_map, None)
    )
    for found in (by_map, by_place):
        assert (found[kept] == record.r[kept] + 1e-3).all()
        assert found[inside] == pytest.approx(record.r[inside], abs=2e-9)
    # Beyond what was recorded only the map knows it.
    x = record.x + 2.0
    assert np.isnan(evaluation._reference_at(stamps, x, stream, record, None)[~kept]).all()


def test_each_reading_of_a_sensor_belongs_to_the_nearest_sample_and_lies_on_a_line_between(tmp_path):
    read = {number: START_NS + number * PERIOD_NS + 180_000 * (-1) ** number for number in range(8, 37, 4)}
    read |= {21: START_NS + 21 * PERIOD_NS - 200_000}
    sensor = [(DISPLACEMENT, stamp, (1e-6 * number**2,)) for number, stamp in sorted(read.items())]
    found = evaluate_bag(bag_of_rows(tmp_path / "bag", [*rows_of(), *sensor]))
    numbers = np.arange(10, COUNT)
    assert found.read.tolist() == [number in read for number in numbers]
    assert found.readings[found.read] == pytest.approx([1e-6 * n**2 for n in numbers if n in read])
    assert np.isnan(found.readings[~found.read]).all() and np.isnan(found.guide[numbers > 36]).all()
    between = ~found.read & (numbers < 36)
    times, places = np.array([(read[n] - START_NS) / PERIOD_NS for n in sorted(read)]), sorted(read)
    expected = np.interp(numbers[between], times, [1e-6 * n**2 for n in places])
    assert found.guide[between] == pytest.approx(expected)
    # Without a sensor no reading is missing.
    without = evaluate_bag(recorded(tmp_path / "without"))
    assert without.guide is without.readings is None and without.read.all()


@pytest.mark.parametrize("changed", [1, 5, 7])
def test_parameters_that_changed_in_the_recording_are_named_up_to_five(tmp_path, monkeypatch, changed):
    order = 0, {"driver.override": "0.3"}
    monkeypatch.setattr(
        evaluation, "noted_changes", lambda _: [*((0, {f"p{one}": "1"}) for one in range(changed)), order]
    )
    with pytest.warns(UserWarning, match="parameters changed while") as found:
        evaluate_bag(recorded(tmp_path / "bag"))
    (text,) = (str(one.message) for one in found)
    assert "override" not in text
    assert [f"p{one}" in text for one in range(7)] == [one < min(changed, 5) for one in range(7)]
    assert ("and 2 more;" in text) == (changed == 7) and ("more" in text) == (changed > 5)


def test_a_truth_that_comes_less_often_is_left_out_and_one_that_lost_some_is_not(tmp_path):
    with pytest.warns(UserWarning, match="'truth' has 20 messages for 40 samples"):
        assert evaluate_bag(recorded(tmp_path / "a", left_out={TRUTH: set(range(0, COUNT, 2))})).record.true_y is None
    assert len(evaluate_bag(recorded(tmp_path / "b", left_out={TRUTH: set(range(0, COUNT, 3))})).record.true_y) == 20


@pytest.mark.parametrize(
    ("later_s", "lockstep", "left_out", "lost_at", "left_on"),
    [
        (None, False, {}, 0.0, False),
        (None, False, {ENCODER: {59}}, 20.0, False),
        (0.015, False, {}, 0.0, False),
        (0.1, False, {}, 20.0, False),
        (0.9, False, {}, 20.0, False),
        (1.1, False, {}, 20.0, True),
        (1.1, True, {}, 0.0, False),
    ],
)
def test_a_run_goes_on_after_its_last_sample_by_answers_and_reports(
    tmp_path, later_s, lockstep, left_out, lost_at, left_on
):
    messages = list(packed(rows_of(left_out=left_out, order=range(-50, 60))))
    if later_s:
        end = START_NS + 59 * PERIOD_NS + round(later_s * 1e9)
        messages.append((DIAGNOSTICS, REPORT, report("driver", end), end, end))
    parameters = "/driver: {ros__parameters: {lockstep: true}}" if lockstep else ""
    found = evaluate_bag(bag_of(tmp_path / "bag", messages, parameters)).encoder
    # 0.01 m in 0.5 ms; so it was when the amplifier was switched on, too.
    assert (found.lost_at, found.on_at) == pytest.approx((lost_at, 20.0))
    assert found.left_on == left_on


def test_streams_that_end_with_the_first_of_them_are_named(tmp_path):
    many = {REFERENCE: set(range(30, COUNT)), COMMAND: set(range(39, COUNT))}
    assert evaluate_bag(recorded(tmp_path / "a", left_out=many)).encoder.ended == "reference and command and truth"
    assert evaluate_bag(recorded(tmp_path / "b", without=(TRUTH,))).encoder.ended == "reference and command"
    first = {TRUTH: set(range(70, 120))}
    assert evaluate_bag(recorded(tmp_path / "c", left_out=first, order=range(120))).encoder.ended == "truth"
