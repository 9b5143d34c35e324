"""A run that lost its law, its amplifier or its clock in motion is never in order."""

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from places import SMC
from rewritten_bag import rewritten
from tiers import nightly

from straightcomp_ros.analysis.interruption import LatchedFault, clock_jump, encoder_run, played, stalls_of
from straightcomp_ros.analysis.record import motion_of, strokes_and_jumps
from straightcomp_ros.bags.reader import StreamColumns
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, REFERENCE, TRUTH
from straightcomp_ros.fleet.history.adding import evaluate_bag
from straightcomp_ros.fleet.history.strokes_of_bag import rows_of

S = 1_000_000_000
LAW = (REFERENCE.topic, COMMAND.topic, "controller_state")
FORWARD = 1.0  # s, in mid-motion of the first stroke


@pytest.fixture
def judged(verb, tmp_path):
    """``judged(bag)``: exit code, and figures or else standard error; with a limit of the true error in µm or not."""

    def run(bag, limit=None):
        options = []
        if limit is not None:
            (tmp_path / "limits.yaml").write_text(f"true_pp_um: {limit}\n")
            options = ["--limits", tmp_path / "limits.yaml"]
        found = verb("evaluate", bag, "--json", *options)
        return found.code, found.json if found.out else found.err

    return run


def off(topic, stamp, numbers):
    """The numbers of a sample with the amplifier off."""
    places = {ENCODER.topic: (ENCODER, "coil_current", np.nan), DRIVER_STATE.topic: (DRIVER_STATE, "enabled", 0.0)}
    if topic in places:
        stream, name, value = places[topic]
        numbers = [value if column == name else one for column, one in zip(stream.layout.columns, numbers, strict=True)]
    return stamp, numbers


@pytest.mark.parametrize(
    ("stamps", "played_s"),
    [
        ([5.0], [0.0]),
        ([5.0, 5.5, 6.0], [0.0, 0.5, 1.0]),
        ([5.0, 28805.0, 28805.5], [0.0, 1.0, 1.5]),
        ([5.0, 1.0, 1.5], [0.0, 0.0, 0.5]),
        ([5.0, 28805.0, 5.5, 6.0], [0.0, 1.0, 1.0, 1.5]),
    ],
)
def test_no_pause_and_no_jump_of_the_clock_is_played_longer_than_a_second_and_none_takes_time_back(stamps, played_s):
    assert played((np.array(stamps) * S).astype(np.int64)) / S == pytest.approx(played_s)


def unchanged(topic, stamp, numbers):
    return stamp, numbers


def when(condition, change=lambda *_: None, otherwise=unchanged):
    """``change`` of the samples for which ``condition(topic, stamp)`` holds; by default they are left out."""
    return lambda topic, stamp, numbers: (change if condition(topic, stamp) else otherwise)(topic, stamp, numbers)


def law_ends_and_the_amplifier(at):
    return when(lambda _, stamp: stamp >= at * S, when(lambda topic, _: topic in LAW, otherwise=off))


def ends(law_s, others_s):
    return when(lambda topic, stamp: stamp >= (law_s if topic in LAW else others_s) * S)


@pytest.mark.parametrize(
    ("change", "times_off"),
    [(ends(FORWARD, math.inf), 0), *nightly((law_ends_and_the_amplifier(at), 1) for at in (0.5, 3.0))],
)
def test_a_run_whose_law_ends_in_motion_is_interrupted_and_its_lost_samples_count(tmp_path, judged, change, times_off):
    bag = rewritten(SMC, tmp_path / "b", change)
    code, found = judged(bag, limit=5)
    assert (code, found["verdict"], found["amplifier_off_in_motion"]) == (1, "interrupted", times_off)
    assert found["lost_commands"] > 1000 and found["lost_references"] == found["lost_commands"]
    rows = rows_of(evaluate_bag(bag), {})
    assert rows[-1].verdict == "interrupted" and {row.verdict for row in rows[:-1]} <= {"in_order"}


def thinned(stream):
    return when(lambda topic, stamp: topic == stream.topic and round(stamp / S / T) % 20)


def x_jumps(topic, stamp, numbers):
    return stamp, [numbers[0] + 0.1, *numbers[1:]]


def begins_at_zero(topic, stamp, numbers):
    return (stamp if stamp < 0.01 * S else stamp + 1_790_000_000 * S), numbers, stamp + 1_790_000_000 * S


DAY = 86400.0


def jump_from(at, by, log_too=False):
    def change(topic, stamp, numbers):
        moved = stamp + round(by * S) if stamp >= at * S else stamp
        return moved, numbers, (moved if log_too else stamp)

    return change


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (when(lambda topic, stamp: S <= stamp < 1.05 * S, off), "interrupted"),
        (when(lambda _, stamp: stamp < FORWARD * S, off), "interrupted"),
        (when(lambda _, stamp: stamp < 0.1 * S, off), "in_order"),
        (when(lambda topic, stamp: topic == ENCODER.topic and stamp >= S, x_jumps), "interrupted"),
        (begins_at_zero, "clock_jumped"),
        (jump_from(FORWARD, 0.05, log_too=True), "clock_jumped"),
        *nightly((jump_from(FORWARD, by), "clock_jumped") for by in (-3 * DAY, -0.05, 3600.0)),
        *nightly((jump_from(FORWARD, by, log_too=True), "clock_jumped") for by in (-1.0, -0.05)),
        # At rest: set back so far, no stroke may be left of what was put in another order.
        (jump_from(2.25, -1.0), ""),
        *nightly((jump_from(*jump), "") for jump in ((0.01, 1.0), (2.25, DAY))),
        # A pause of the recording.
        (jump_from(2.25, DAY / 3, log_too=True), "in_order"),
        # Less than half of the travel in the record: of bursts, or of a stream that someone throttled.
        (when(lambda _, stamp: stamp % (0.95 * S) >= 0.06 * S), "starved"),
        (thinned(REFERENCE), "starved"),
        *nightly([(thinned(COMMAND), "starved")]),
        # Stopped in motion, streams end some milliseconds apart.
        (ends(0.99, 1.0), "in_order"),
    ],
)
def test_what_breaks_a_motion_is_named(tmp_path, judged, change, verdict):
    code, found = judged(rewritten(SMC, tmp_path / "b", change))
    assert code == (verdict != "in_order")
    assert verdict in (found["verdict"] if isinstance(found, dict) else found.replace(" ", "_"))
    assert code or found["lost_commands"] == 0


def bulge(topic, stamp, numbers):
    """20 µm on the platform's position from 0.9 to 1.2 s."""
    if 0.9 * S <= stamp < 1.2 * S and topic in (ENCODER.topic, TRUTH.topic):
        numbers[1] += 20e-6 * np.sin(np.pi * (stamp / S - 0.9) / 0.3)
    return stamp, numbers


@pytest.mark.parametrize(
    ("missing", "mapped"), [(REFERENCE, True), (COMMAND, True), *nightly([(TRUTH, True), (REFERENCE, False)])]
)
@pytest.mark.parametrize(("change", "verdict"), [(bulge, "starved"), (unchanged, "in_order")])
def test_an_error_in_samples_that_lack_an_answer_is_no_order(tmp_path, judged, missing, mapped, change, verdict):
    lacking = when(lambda topic, stamp: topic == missing.topic and 0.9 * S <= stamp < 1.2 * S, otherwise=change)
    bag = rewritten(SMC, tmp_path / "b", lacking, lambda name, data: data if mapped or "yaml" in name else None)
    code, found = judged(bag, limit=5)
    assert (code, found["verdict"]) == (verdict != "in_order", verdict)
    assert {row.verdict for row in rows_of(evaluate_bag(bag), {})} == {verdict, "in_order"}


@pytest.mark.parametrize(("since", "until"), [(0.7, 1.9), *nightly([(1.5, 3.0), (2.2, 3.5)])])
def test_a_gap_of_the_recording_in_motion_is_a_loss_however_long_it_is(tmp_path, judged, since, until):
    bag = rewritten(SMC, tmp_path / "b", when(lambda _, stamp: since * S <= stamp < until * S))
    code, found = judged(bag)
    assert (code, found["verdict"], found["lost_samples"]) == (1, "interrupted", round((until - since) / T))
    assert found["longest_gap_s"] == pytest.approx(until - since, abs=2 * T) and found["gaps"] == 1
    assert "interrupted" in {row.verdict for row in rows_of(evaluate_bag(bag), {})}


def test_strokes_on_both_sides_of_a_jump_of_x_are_found_and_a_jump_is_no_stroke():
    time = np.arange(4000) * 5e-4
    x = np.where(time < 1.0, time * 0.05, 0.3 + time * 0.05)
    assert [one.direction for one in motion_of(time, x).strokes] == ["forward", "forward"]
    # At 1.5 m/s each kHz, with a sample lost: the way from one to the next is more than a jump would be.
    lost = np.delete(np.arange(400), 200)
    (one,) = motion_of(lost * 1e-3, lost * 1.5e-3).strokes
    assert (one.start, one.stop) == (1, lost.size - 1)
    jumped = np.where(lost < 202, 0.0, 0.1) + lost * 1.5e-3
    assert strokes_and_jumps(lost * 1e-3, jumped)[1][0] == 201
    # Between two gaps the jump is a single move, of which only the means on both sides tell that it is none.
    between = np.delete(np.arange(4000), [1999, 2002])
    jumped = np.where(between < 2001, 0.0, 0.1) + between * 2.5e-5
    assert strokes_and_jumps(between * 5e-4, jumped)[1].tolist() == [2000]
    with pytest.raises(ValueError, match="x jumps by 100 mm"):
        motion_of(time, np.where(time < 1.0, 0.0, 0.1))


def test_times_that_follow_each_other_share_the_samples_in_motion():
    run = encoder_run(SAMPLES, 0.1 * SAMPLES * 1e-9, np.ones(SAMPLES.size, bool), int(SAMPLES[-1]))
    (stroke,), times = run.strokes, [0, *SAMPLES[[400, 401, 1500]].tolist(), 2 * S]
    parts = [run.moving(*pair) for pair in itertools.pairwise(times)]
    assert np.sum(parts, axis=0)[stroke.samples].tolist() == [1] * (stroke.stop - stroke.start)
    assert [int(part.sum()) for part in parts[1:3]] == [1, 1099]


def test_a_recording_that_is_cut_off_at_rest_with_the_amplifier_on_is_interrupted(tmp_path, judged):
    bag = rewritten(SMC, tmp_path / "b", ends(2.25, 2.25))
    assert judged(bag)[1]["verdict"] == "in_order"
    (file,) = bag.glob("*.mcap")
    # Without the summary: the logger was killed.
    file.write_bytes(file.read_bytes()[:-200])
    assert judged(bag)[1]["verdict"] == "interrupted"


PERIOD_NS, T = 500_000, 5e-4
SAMPLES = np.arange(2000, dtype=np.int64) * PERIOD_NS


def driver(**changes: dict[int, float]) -> dict[str, np.ndarray]:
    """The driver's record of a quiet run, with other values at some samples."""
    columns = {
        "command_latency": np.full(SAMPLES.size, 150e-6),
        "lateness": np.full(SAMPLES.size, 40e-6),
        "enabled": np.ones(SAMPLES.size),
    }
    for name, values in changes.items():
        for place, value in values.items():
            columns[name][place] = value
    return columns


LEFT = np.delete(SAMPLES, range(1000, 1010))
ANSWERED = np.delete(SAMPLES, [*range(300, 303), *range(1990, 2000)])
SILENT, OFF = dict.fromkeys(range(400, 420), np.nan), dict.fromkeys(range(400, 420), 0.0)
IN_BATCHES = dict.fromkeys((k for k in range(2000) if k % 4), np.nan)
NONE = SAMPLES[:0]


@pytest.mark.parametrize(
    ("samples", "answered", "of_driver", "columns", "expected"),
    [
        pytest.param(SAMPLES, SAMPLES, SAMPLES, driver(), None, id="quiet"),
        pytest.param(SAMPLES, SAMPLES, NONE, {}, None, id="quiet, and no driver recorded"),
        pytest.param(LEFT, LEFT, NONE, {}, (999 * T, 1010 * T), id="lost: from the sample before to the one after"),
        pytest.param(SAMPLES, ANSWERED, NONE, {}, (300 * T, 303 * T), id="no command, but after the last one"),
        *(
            pytest.param(SAMPLES, SAMPLES, SAMPLES, driver(**changes), expected, id=what)
            for what, changes, expected in (
                ("late command", {"command_latency": {700: 5e-3, 900: 600e-6}}, (700 * T - 5.5e-3, 700 * T)),
                ("late sample", {"lateness": {700: 5e-3, 900: 500e-6}}, (700 * T, 700 * T + 5e-3)),
                ("silent controller", {"command_latency": SILENT}, (399 * T, 419 * T)),
                ("silent with the amplifier off", {"command_latency": SILENT, "enabled": OFF}, None),
                ("one silent sample", {"command_latency": {400: np.nan}}, None),
                ("same delay always", {"command_latency": dict.fromkeys(range(2000), 5.0 * T)}, None),
                ("answers in batches", {"command_latency": IN_BATCHES}, None),
            )
        ),
    ],
)
def test_a_stall_is_found_in_lost_samples_missing_and_late_commands(samples, answered, of_driver, columns, expected):
    found = stalls_of(samples, answered, of_driver, columns)
    assert found == ([] if expected is None else [pytest.approx(expected)])


def test_stalls_are_in_order_and_those_that_touch_are_one():
    left, answered = np.delete(SAMPLES, [700, 701]), np.delete(SAMPLES, [0, 2, 700, 701, 1200, 1201, 1997, 1999])
    late = driver(command_latency={699: 5e-3, 705: 5e-3, 1500: 3e-3}, lateness={1202: 1e-3})
    found = stalls_of(left, answered, SAMPLES, late)
    # From the late answer over the lost samples to another one; samples without a command, and a late one after them.
    together = [(2, 3), (688, 705), (1200, 1204), (1493, 1500), (1997, 1998)]
    assert found == [pytest.approx((begin * T, end * T)) for begin, end in together]


def jumped(by, at=1000, speed=0.0, after=None, log_too=False, lost=0):
    """A second of samples whose stamps go on from another time, in s, of a stage at this speed in m/s, whose recording
    delays them by up to 4 ms. So many samples are lost at the jump."""
    kept = np.delete(np.arange(2000), range(at, at + lost))
    stamps = S + kept * PERIOD_NS
    moved = stamps + np.where(kept < at, 0, round(by * S))
    x = speed * (kept - at) * T * np.where(kept < at, 1.0, 1.0 if after is None else after)
    log = (moved if log_too else stamps) + 1_000_000 * (kept % 4 + 1)
    return StreamColumns(log, moved, {"x": x, "y": np.where(kept % 7, 1e-7 * kept, np.nan)})


@pytest.mark.parametrize(
    ("by", "said", "samples"),
    [
        *((by, words, {}) for by, words in ((0.05, "50 ms"), (-0.05, "-50 ms"), (2.0, "2 s"), (7200.0, "2 h"))),
        *((3 * 86400.0, "3 d", {"at": at}) for at in (1, 25, 1999)),
        (0.025, "25 ms", {}),
        (0.019, "", {}),
        # The recording's clock went with it: then the way of the stage says it.
        *((0.05, "50 ms", {"speed": speed, "log_too": True, "lost": 3}) for speed in (6e-4, -0.3)),
        (0.05, "50 ms", {"speed": 0.3, "log_too": True, "at": 20}),
        (0.05, "50 ms", {"speed": 0.3, "log_too": True, "at": 1980}),
        (-0.05, "-50 ms", {"speed": 0.3, "log_too": True}),
        (0.019, "", {"speed": 0.3, "log_too": True}),
        # It says nothing where it stands or creeps, has turned, or went on for longer than some samples, nor of few.
        *((0.05, "", {"speed": speed, "log_too": True}) for speed in (0.0, 4e-4, -4e-4)),
        (0.05, "", {"speed": 0.3, "after": -1.0, "log_too": True}),
        (0.05, "", {"speed": 0.3, "log_too": True, "lost": 6}),
        (0.05, "", {"speed": 0.3, "log_too": True, "at": 19}),
        (0.05, "", {"speed": 0.3, "log_too": True, "at": 1981}),
        (0.0, "", {"lost": 100}),
        (0.0, "", {"lost": 100, "speed": 0.3}),
    ],
)
def test_a_jump_of_the_clock_has_the_size_that_recording_or_motion_show(by, said, samples):
    found = clock_jump(jumped(by, **samples))
    if not said:
        assert found == ""
    else:
        assert f"jump by {said} after sample {samples.get('at', 1000) - 1}," in found


def test_a_clock_that_is_set_back_by_some_samples_repeats_their_stamps_with_other_readings_and_a_late_sample_does_not():
    back = jumped(-10 * T)
    assert clock_jump(back).startswith("10 stamps came twice")
    # The same sample twice is no jump, whatever it reads.
    again = np.sort(np.append(np.arange(2000), np.arange(990, 1010)))
    assert clock_jump(jumped(0.0).taken(again)) == clock_jump(jumped(0.0)) == ""
    assert clock_jump(back.taken(np.zeros(5, int))) == ""
    # Nor are single samples that the recording has among later ones.
    late = np.where(np.arange(2000) % 200, 0, 60)
    delayed = replace(jumped(0.0), log_time=jumped(0.0).log_time + late * PERIOD_NS)
    assert clock_jump(delayed.taken(np.argsort(np.arange(2000) + late))) == ""


def test_a_recording_that_stalls_or_runs_slowly_or_drifts_has_no_jump_where_samples_are_lost():
    stamps = np.delete(np.arange(6000), [2998, 2999, 3000]) * 10_000_000
    x = {"x": 0.0 * stamps, "y": 0.0 * stamps}
    stalled = np.where((stamps > 30 * S) & (stamps < 31 * S), 31 * S, stamps)
    for log in (stalled, stamps + stamps // 1000, 3 * stamps, stamps // 3):
        assert clock_jump(StreamColumns(log, stamps, x)) == ""


@pytest.mark.parametrize(
    ("said", "changes"),
    [
        ("", {}),
        ("", {"judged": 1970}),
        ("after 0.700 s no sample has truth, 598 more of the motion have none", {"judged": 1400, "ended": "truth"}),
        ("x jumps at 0.500 s", {"jump": 1000}),
        ("the amplifier was off for 10 samples of the motion", {"off": slice(500, 510)}),
        ("", {"off": slice(1999, 2000)}),
        ("the amplifier was switched on with the stage moving at 0.6 mm/s", {"on_at": 0.6e-3}),
        ("", {"on_at": 0.4e-3}),
        ("the samples end with the amplifier on and the stage moving at 100 mm/s", {"goes_on": True}),
        ("the samples end with the amplifier on and the stage moving at 100 mm/s", {"silent": True}),
        ("no sample came for 1.500 s after 0.500 s", {"hole": 1001}),
    ],
)
def test_an_interruption_says_what_when_and_how_much_and_that_of_another_time_is_none(said, changes):
    changes = dict(changes)
    stamps, x, on = SAMPLES.copy(), 0.1 * SAMPLES / S, np.ones(SAMPLES.size, bool)
    stamps[changes.pop("hole", 2000) :] += 1_499_500_000
    x[changes.pop("jump", 2000) :] += 0.1
    on[changes.pop("off", slice(0))] = False
    run = encoder_run(stamps, x, on, int(stamps[changes.pop("judged", 1999)]), **changes)
    assert run.interruption((), 0, 3 * S, 0) == said
    for begin, until in ((-S, 0), (3 * S, 4 * S)):
        assert run.interruption((), begin, until, 0) == ""
    # On a clock that began earlier.
    assert re.sub(r"\d+\.\d+ s", "", run.interruption((), 0, 3 * S, -S)) == re.sub(r"\d+\.\d+ s", "", said)


def test_a_stage_that_moved_while_nothing_was_recorded_is_no_pause_and_one_that_stood_is():
    stamps = SAMPLES + np.where(np.arange(2000) < 1000, 0, 8 * S)
    for moved, pauses in ((0.0, 1), (0.04e-3, 1), (0.06e-3, 0), (0.1, 0)):
        x = np.interp(np.arange(2000), [0, 500, 999, 1000, 1500, 2000], [0.0, 0.01, 0.01, 0.01, 0.01, 0.0])
        x += np.where(np.arange(2000) < 1000, 0.0, moved)
        assert encoder_run(stamps, x, np.ones(2000, bool), int(stamps[-1])).pauses.tolist() == [stamps[999]] * pauses


def test_of_the_faults_of_a_node_the_first_counts_and_all_from_the_begin_to_before_the_end():
    run = encoder_run(SAMPLES, 0.0 * SAMPLES, np.ones(SAMPLES.size, bool), int(SAMPLES[-1]))
    faults = [LatchedFault(at * S // 10, label, "hot") for at, label in ((1, "a"), (2, "b"), (3, "a"), (4, "c"))]
    said = "fault a at 0.100 s (hot); fault b at 0.200 s (hot)"
    assert run.interruption(faults, S // 10, 4 * S // 10, 0) == said
    assert run.interruption(faults, S // 10 + 1, 2 * S // 10, 0) == ""
    assert run.unanswered(SAMPLES[:-1]) == 1 and run.unanswered(np.delete(SAMPLES, [3, 4])) == 2
