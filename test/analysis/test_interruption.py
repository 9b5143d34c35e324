"""A run that lost its law, its amplifier or its clock in motion is never in order."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rewritten_bag import SMC, rewritten

from straightcomp_ros.analysis.interruption import stalls_of
from straightcomp_ros.analysis.record import motion_of
from straightcomp_ros.cli.main import main
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, REFERENCE
from straightcomp_ros.fleet.history.adding import evaluate_bag
from straightcomp_ros.fleet.history.strokes_of_bag import Recorded, rows_of

S = 1_000_000_000
LAW = (REFERENCE.topic, COMMAND.topic, "controller_state")
FORWARD = 1.0  # s, in mid-motion of the first stroke


def judged(bag, capsys, *options):
    code = main(["evaluate", str(bag), "--json", *options])
    found = capsys.readouterr()
    return code, json.loads(found.out) if found.out else found.err


def off(topic, stamp, numbers):
    """The numbers of a sample with the amplifier off."""
    places = {ENCODER.topic: (ENCODER, "coil_current", np.nan), DRIVER_STATE.topic: (DRIVER_STATE, "enabled", 0.0)}
    if topic in places:
        stream, name, value = places[topic]
        numbers = [value if column == name else one for column, one in zip(stream.layout.columns, numbers, strict=True)]
    return stamp, numbers


def law_ends(at, amplifier=off):
    def change(topic, stamp, numbers):
        if stamp < at * S:
            return stamp, numbers
        return None if topic in LAW else amplifier(topic, stamp, numbers)

    return change


def on(topic, stamp, numbers):
    return stamp, numbers


@pytest.mark.parametrize(("at", "amplifier"), [(0.5, off), (FORWARD, on), (3.0, off)])
def test_a_run_whose_law_ends_in_motion_is_interrupted_and_its_lost_samples_count(tmp_path, capsys, at, amplifier):
    bag = rewritten(SMC, tmp_path / "b", law_ends(at, amplifier))
    code, found = judged(bag, capsys)
    assert (code, found["verdict"]) == (1, "interrupted")
    assert found["lost_commands"] > 1000 and found["lost_references"] == found["lost_commands"]
    assert found["amplifier_off_in_motion"] == (amplifier is off)
    limits = tmp_path / "limits.yaml"
    limits.write_text("true_pp_um: 5\n")
    assert judged(bag, capsys, "--limits", str(limits))[0] == 1
    rows = rows_of(evaluate_bag(bag), Recorded())
    assert rows[-1].verdict == "interrupted" and {row.verdict for row in rows[:-1]} <= {"in_order"}


def test_streams_that_end_some_milliseconds_apart_do_not_interrupt_a_recording_stopped_in_motion(tmp_path, capsys):
    def change(topic, stamp, numbers):
        return (stamp, numbers) if stamp < (0.99 if topic in LAW else 1.0) * S else None

    code, found = judged(rewritten(SMC, tmp_path / "b", change), capsys)
    assert (code, found["verdict"], found["lost_commands"]) == (0, "in_order", 0)


def off_for_some_samples(topic, stamp, numbers):
    return off(topic, stamp, numbers) if S <= stamp < 1.05 * S else (stamp, numbers)


def driver_ends(topic, stamp, numbers):
    return (stamp, numbers) if stamp < (1.0 if topic in LAW else 0.999) * S else None


def x_jumps(topic, stamp, numbers):
    return stamp, [numbers[0] + 0.1, *numbers[1:]] if topic == ENCODER.topic and stamp >= S else numbers


def begins_at_zero(topic, stamp, numbers):
    return (stamp if stamp < 0.01 * S else stamp + 1_790_000_000 * S), numbers, stamp + 1_790_000_000 * S


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (off_for_some_samples, "interrupted"),
        (driver_ends, "interrupted"),
        (x_jumps, "interrupted"),
        (begins_at_zero, "clock_jumped"),
    ],
)
def test_what_breaks_a_motion_is_named(tmp_path, capsys, change, verdict):
    assert judged(rewritten(SMC, tmp_path / "b", change), capsys)[1]["verdict"] == verdict


def jump_from(at, by, log_too=False):
    def change(topic, stamp, numbers):
        moved = stamp + round(by * S) if stamp >= at * S else stamp
        return moved, numbers, (moved if log_too else stamp)

    return change


@pytest.mark.parametrize(
    ("by", "log_too"),
    [(-3 * 86400.0, False), (-1.0, True), (-0.05, True), (-0.05, False), (0.05, True), (3600.0, False)],
)
def test_a_clock_that_jumps_in_motion_is_named(tmp_path, capsys, by, log_too):
    code, found = judged(rewritten(SMC, tmp_path / "b", jump_from(FORWARD, by, log_too)), capsys)
    assert code == 1
    # Set back so far, no stroke may be left of what was put in another order.
    assert "clock_jumped" in (found["verdict"] if isinstance(found, dict) else found.replace(" ", "_"))


@pytest.mark.parametrize(("at", "by"), [(0.01, 1.0), (2.25, -1.0), (2.25, 86400.0)])
def test_a_clock_that_jumps_at_rest_is_named_where_the_recording_has_its_own(tmp_path, capsys, at, by):
    assert judged(rewritten(SMC, tmp_path / "b", jump_from(at, by)), capsys)[0] == 1


def test_a_pause_of_the_recording_at_rest_is_no_jump_no_loss_and_no_stall(tmp_path, capsys):
    night = 8 * 3600
    code, found = judged(rewritten(SMC, tmp_path / "b", jump_from(2.25, night, True)), capsys)
    assert (code, found["verdict"], found["lost_samples"]) == (0, "in_order", 0)
    whole = judged(SMC, capsys)[1]
    assert found["true_pp_um"] == pytest.approx(whole["true_pp_um"], rel=0.05)
    assert found["warnings"]


def test_an_order_of_recording_that_is_not_that_of_the_stamps_is_no_jump(tmp_path, capsys):
    def late(topic, stamp, numbers):
        return stamp, numbers, stamp + (30_000_000 if topic == ENCODER.topic and stamp % (100 * S // 1000) == 0 else 0)

    bag = rewritten(SMC, tmp_path / "b", late)
    with (bag / "b_0.mcap").open("rb") as file, (tmp_path / "sorted.mcap").open("wb") as target:
        reader, writer = make_reader(file), Writer(target)
        writer.start("ros2")
        ids = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(ids[channel.id], message.log_time, message.data, message.log_time)
        writer.finish()
    assert judged(tmp_path / "sorted.mcap", capsys)[1]["verdict"] == "in_order"


def test_strokes_on_both_sides_of_a_jump_of_x_are_found_and_a_jump_is_no_stroke():
    time = np.arange(4000) * 5e-4
    x = np.where(time < 1.0, time * 0.05, 0.3 + time * 0.05)
    assert [one.direction for one in motion_of(time, x).strokes] == ["forward", "forward"]
    with pytest.raises(ValueError, match="x jumps by 100 mm"):
        motion_of(time, np.where(time < 1.0, 0.0, 0.1))


def test_a_recording_that_is_cut_off_at_rest_with_the_amplifier_on_is_interrupted(tmp_path, capsys):
    def change(topic, stamp, numbers):
        return (stamp, numbers) if stamp < 2.25 * S else None

    bag = rewritten(SMC, tmp_path / "b", change)
    assert judged(bag, capsys)[1]["verdict"] == "in_order"
    (file,) = bag.glob("*.mcap")
    # Without the summary: the logger was killed.
    file.write_bytes(file.read_bytes()[:-200])
    assert judged(bag, capsys)[1]["verdict"] == "interrupted"


PERIOD_NS = 500_000
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


def test_a_quiet_run_has_no_stall():
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver()) == []
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES[:0], {}) == []


def test_lost_samples_are_a_stall_from_the_sample_before_to_the_one_after():
    left = np.delete(SAMPLES, range(1000, 1010))
    (stall,) = stalls_of(left, left, left[:0], {})
    assert stall == pytest.approx((999 * 5e-4, 1010 * 5e-4))


def test_samples_without_a_command_are_one_stall_and_those_after_the_last_command_are_none():
    answered = np.delete(SAMPLES, [*range(300, 303), *range(1990, 2000)])
    (stall,) = stalls_of(SAMPLES, answered, SAMPLES[:0], {})
    assert stall == pytest.approx((300 * 5e-4, 303 * 5e-4))


def test_a_late_command_and_a_late_sample_are_stalls_and_jitter_below_a_period_is_none():
    (stall,) = stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency={700: 5e-3, 900: 600e-6}))
    assert stall == pytest.approx((700 * 5e-4 - 5.5e-3, 700 * 5e-4))
    (stall,) = stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(lateness={700: 5e-3, 900: 500e-6}))
    assert stall == pytest.approx((700 * 5e-4, 700 * 5e-4 + 5e-3))


def test_a_controller_that_is_silent_is_a_stall_while_the_amplifier_is_on():
    silent = dict.fromkeys(range(400, 420), np.nan)
    (stall,) = stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency=silent))
    assert stall == pytest.approx((399 * 5e-4, 419 * 5e-4))
    off = dict.fromkeys(range(400, 420), 0.0)
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency=silent, enabled=off)) == []
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency={400: np.nan})) == []


def test_a_delay_that_is_always_the_same_is_no_stall_however_long():
    columns = driver() | {"command_latency": np.full(SAMPLES.size, 5.0 * 5e-4)}
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, columns) == []


def test_a_controller_that_answers_several_samples_at_once_does_not_stall():
    in_batches = dict.fromkeys((k for k in range(2000) if k % 4), np.nan)
    assert stalls_of(SAMPLES, SAMPLES, SAMPLES, driver(command_latency=in_batches)) == []
