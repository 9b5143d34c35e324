"""A recorded run computed again."""

from pathlib import Path

import numpy as np
import pytest
import rewritten_bag
import yaml
from bag_of_rows import bag_of, bag_of_rows
from recorded_run import recorded_run
from rewritten_bag import rewritten

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.record import MetricsError
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_streams
from straightcomp_ros.bags.recorded_nodes import note_changes
from straightcomp_ros.contract import COMMAND, CONTROLLER_STATE, ENCODER, REFERENCE, STREAMS
from straightcomp_ros.control.laws import LAWS, make_law
from straightcomp_ros.control.pairing import Pairing
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.offline.audit import audit
from straightcomp_ros.offline.what_if import what_if
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, by_node, node_parameters

PERIOD_NS = 500_000
CYCLE = {"motion.stroke": 0.03, "motion.settle": 0.1, "motion.pause": 0.05}
LAYOUTS = {stream.topic: stream.layout for stream in STREAMS}


def simulated(path: Path, law: str = "smc") -> Path:
    return recorded_run(path, {"controller": {"control.law": law}, "stage": CYCLE})


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return simulated(tmp_path_factory.mktemp("bags") / "run")


def unchanged(topic, stamp, numbers):
    return stamp, numbers


def one_bit_more(changed, at, place):
    def change(topic, stamp, numbers):
        if (topic, stamp) == (changed, at * PERIOD_NS):
            numbers[place] = float(np.nextafter(numbers[place], 1.0))
        return stamp, numbers

    return change


@pytest.mark.parametrize("law", LAWS)
def test_every_command_comes_out_the_same_to_the_bit(tmp_path, law):
    path = simulated(tmp_path / "run", law)
    found = audit(path)
    assert found.commands == len(read_streams(path, LAYOUTS)["command"]) > 1000
    assert (found.law, found.different, found.unverified, found.missing) == (law, 0, 0, 0)


def test_one_bit_in_a_command_or_a_sample_and_other_parameters_are_found(bag, tmp_path):
    found = audit(rewritten(bag, tmp_path / "command", one_bit_more("command", 700, 0)))
    assert (found.different, found.unverified) == (1, 0)
    assert (found.first.step, found.first.column) == (700, "control_current")
    assert found.first.recorded != found.first.computed == pytest.approx(found.first.recorded)
    found = audit(rewritten(bag, tmp_path / "sample", one_bit_more("encoder", 500, 1)))
    assert found.different >= 1 and found.first.step == 500
    linear = rewritten(bag, tmp_path / "law", unchanged, lambda _, data: data.replace(b"law: smc", b"law: linear"))
    assert not audit(linear).passed


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(("stream", "different"), [(COMMAND, 2), (ENCODER, 0), (REFERENCE, 0)])
def test_of_two_messages_with_one_stamp_both_commands_are_compared_and_no_input_is_guessed(
    bag, tmp_path, stream, different, first
):
    """A second controller answers before the first or after it. A message that comes again as it was is no other."""
    rows = []
    for each in (ENCODER, REFERENCE, COMMAND, CONTROLLER_STATE):
        own = read_streams(bag, LAYOUTS)[each.topic]
        for place, (stamp, *numbers) in enumerate(zip(own.stamp.tolist(), *own.columns.values(), strict=True)):
            rows.append((each, stamp, numbers))
            if each is stream and place in (600, 700, 800):
                other = [number + 1e-6 * (place > 600) for number in numbers]
                rows.insert(len(rows) - first, (each, stamp, other))
    found = audit(bag_of_rows(tmp_path / "new", rows, read_attachments(bag)["parameters.yaml"].decode()))
    assert (found.different, found.passed, found.commands >= 700) == (different, not different, True)
    assert (found.unverified == 0) == (stream is COMMAND)


def test_what_came_after_a_change_of_the_controller_is_unverifiable_and_the_change_is_said(tmp_path):
    values = {"controller": {"control.law": "smc"}, "stage": {**CYCLE, "motion.settle": 4.0}}
    before, stamps = by_node(values), []
    after = {**before, "controller": {**before["controller"], "control.law": "linear"}}

    def see(run, sample, *answer):
        if len(stamps) == 7000:
            note_changes(run._bag, 1_000_000_000 + sample.stamp_ns, before, before)
            note_changes(run._bag, 1_000_000_000 + sample.stamp_ns, before, after)
        stamps.append(sample.stamp_ns)
        run.add(sample, *answer)

    # In truth another law would answer then.
    bag = rewritten(recorded_run(tmp_path / "run", values, see), tmp_path / "new", one_bit_more("command", 7010, 0))
    found = audit(bag)
    assert found.passed and found.changed and found.unverified + found.commands == len(stamps)
    assert 0 < 7000 - found.commands < 5000
    assert not audit(rewritten(bag, tmp_path / "broken", one_bit_more("command", 700, 0))).passed
    # In lockstep the stamps may run at a third of the recorder's pace, which is that of the notice.
    change = one_bit_more("command", 3000, 0)
    slow = audit(rewritten(bag, tmp_path / "slow", lambda topic, at, numbers: (*change(topic, at, numbers), 3 * at)))
    assert slow.passed and slow.commands == 1001
    with pytest.warns(UserWarning, match="changed while .*'controller.control.law' linear"):
        evaluate_bag(bag)


def test_no_stage_is_audited_by_the_streams_of_another(bag, tmp_path):
    messages = [(topic, read_messages(bag, topic)) for topic in ("encoder", "reference", "command", "controller_state")]
    both = [
        (f"{space}/{topic}", one.type_name, data, *times)
        for space in ("", "/b")
        for topic, one in messages
        for data, *times in zip(one.data, one.log_time, one.publish_time, strict=True)
        if (space, topic) != ("", "command")
    ]
    two = bag_of(tmp_path / "two", both, read_attachments(bag)["parameters.yaml"].decode())
    with pytest.raises(BagError, match="has no messages on 'command'"):
        audit(two)
    assert audit(two, {"encoder": "/b/encoder"}) == audit(bag)


CONTROLLER = ControllerNodeParameters()
LEAD = round(CONTROLLER.reference_lead * CONTROLLER.stage.rate)


@pytest.mark.parametrize(
    ("gone", "commands", "missing"),
    [
        ({"encoder": (600, 601)}, 600, 1),
        ({"reference": (600, 601)}, 600 + LEAD, 1),
        ({"controller_state": (600, 601)}, 600, 1),
        # A lost command costs its own verification only.
        ({"command": (600, 601)}, -1, 0),
        # Until the law starts again; the streams of a logger that paused go on at different moments.
        ({"controller_state": (600, 650)}, 600, 50),
        ({"controller_state": (600, 650), "encoder": (600, 650), "command": (600, 655)}, 600, 0),
        # Recorded from the middle of a run on.
        (dict.fromkeys(("encoder", "command", "controller_state"), (0, 400)), 0, 0),
    ],
)
def test_what_is_lost_makes_what_follows_from_it_unverifiable_and_never_different(
    bag, tmp_path, gone, commands, missing
):
    """``gone`` has the first sample of a stream that is lost and the next one that is not; −1 commands are all but
    one."""

    def change(topic, stamp, numbers):
        first, after = gone.get(topic, (0, 0))
        return None if first * PERIOD_NS <= stamp < after * PERIOD_NS else (stamp, numbers)

    path = rewritten(bag, tmp_path / "new", change)
    found, streams = audit(path), read_streams(path, LAYOUTS)
    steps = len({*streams["command"].stamp.tolist(), *streams["controller_state"].stamp.tolist()})
    assert found.commands == commands % steps and found.commands + found.unverified == steps
    assert (found.different, found.missing) == (0, missing)
    assert found.began_running == (commands == 0) == (not found.passed)


def live(path: Path, seed: int) -> Path:
    """A loop in real time as the controller node runs it: references come late, samples get lost or come twice, some
    are not finite, the amplifier goes off and on; all is recorded."""
    source = np.random.default_rng(seed)
    values = {"controller": {"control.law": "smc_observer"}}
    controller = node_parameters("controller", values)
    servo = Servo(make_law(controller.control, controller.stage))
    pairing = Pairing(8 * PERIOD_NS, wait=False)
    rows, late = [], []
    for k in range(3000):
        stamp = 1_700_000_000_000_000_000 + k * PERIOD_NS + (30_000_000 if k > 2000 else 0)
        on = not 900 <= k < 1000
        y = 1e-6 * np.sin(k / 300) + 1e-8 * source.integers(-5, 5)
        numbers = (k * 1e-4, float("nan") if k % 777 == 5 else float(y), float("nan"), 0.01 if on else float("nan"))
        reference = (1e-6 * np.sin(k / 300), 6.7e-6 * np.cos(k / 300), 0.0)
        rows += [(ENCODER, stamp, numbers), (REFERENCE, stamp, reference)]
        late.append((stamp, reference))
        if source.random() < 0.7:
            for one in late:
                pairing.add_reference(*one)
            late.clear()
        if source.random() < 0.02:
            continue  # lost on its way to the controller, not on its way to the logger
        for _ in range(2 if source.random() < 0.02 else 1):
            pairing.add_sample(stamp, numbers)
        for taken, sample, given, age_ns in pairing.take():
            command = servo.step(taken, sample[1], sample[3], given)
            if command is not None:
                rows.append((COMMAND, taken, [command.current]))
                rows.append((CONTROLLER_STATE, taken, [*command[1:], age_ns * 1e-9]))
    return bag_of_rows(path, rows, "controller:\n  ros__parameters: {control.law: smc_observer}\n")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_run_with_late_references_and_lost_samples_is_verified_whole(tmp_path, seed):
    path = live(tmp_path / "live", seed)
    ages = read_streams(path, LAYOUTS)["controller_state"].columns["reference_age"]
    assert len(np.unique(ages)) > 3
    found = audit(path)
    assert (found.different, found.unverified, found.missing) == (0, 0, 0)
    assert found.commands > 2500


def test_the_recorded_parameters_give_the_recorded_figures_and_another_law_changes_them_and_not_the_motion(bag):
    recorded, again = what_if(bag, {})
    assert recorded.law == again.law == "smc"
    # The recorded motion is known to an encoder count; the peaks of friction reversals depend on less.
    for name, tolerance in {"true_rms": 0.05, "true_pp": 0.2, "uncompensated_pp": 1e-3}.items():
        assert getattr(again.metrics, name) == pytest.approx(getattr(recorded.metrics, name), rel=tolerance)
    _, _, changed = what_if(bag, {"controller": {"control.law": "linear"}})
    assert changed.law == "linear" and changed.metrics.true_rms > 1.5 * recorded.metrics.true_rms
    assert changed.metrics.uncompensated_pp == pytest.approx(recorded.metrics.uncompensated_pp, rel=1e-3)


def test_a_pause_of_the_recording_is_not_simulated(bag, tmp_path):
    forward, backward = evaluate_bag(bag).record.motion.strokes
    night = lambda at: 8 * 3600 * 10**9 * (at > (forward.stop + backward.start) // 2 * PERIOD_NS)  # noqa: E731
    paused = rewritten(bag, tmp_path / "new", lambda _, at, numbers: (at + night(at), numbers, at + night(at)))
    with pytest.warns(UserWarning, match="paused for 28800"):
        recorded, again = what_if(paused, {})
    assert recorded.verdict.in_order and again.verdict.in_order
    assert again.metrics.true_pp == pytest.approx(recorded.metrics.true_pp, rel=0.2)


@pytest.mark.parametrize("whole", [True, False], ids=["jump of the clock", "gap"])
def test_a_motion_whose_time_is_not_known_is_not_simulated(bag, tmp_path, whole):
    forward = evaluate_bag(bag).record.motion.strokes[0]
    middle = (forward.start + forward.stop) // 2 * PERIOD_NS
    later = lambda at: at + 3600 * 10**9 * (at > middle)  # noqa: E731
    gap = lambda at: not whole and forward.start * PERIOD_NS <= at < forward.stop * PERIOD_NS  # noqa: E731
    change = lambda _, at, numbers: None if gap(at) else (later(at), numbers, later(at))  # noqa: E731
    with pytest.raises(MetricsError, match="its clock jumped, or samples lack for 1 s in motion"):
        what_if(rewritten(bag, tmp_path / "new", change), {})


def test_the_command_audits_and_names_the_first_step_that_differs(bag, tmp_path, verb):
    found = verb("replay", bag, "--json")
    assert (found.code, found.json["different"]) == (0, 0)
    found = verb("replay", rewritten(bag, tmp_path / "new", one_bit_more("command", 7, 0)))
    assert found.code == 1 and "step 7" in found.err


@pytest.mark.parametrize("options", ["", "--law linear", "--set stage.platform.mass=3", "--graph"])
@pytest.mark.parametrize(
    ("without", "words"),
    [
        ("controller", "the controller's parameters are not attached"),
        ("feedforward", "record again with the feedforward among the logger's 'nodes'"),
    ],
)
def test_nothing_is_computed_again_with_parameters_or_a_map_that_the_run_did_not_have(
    bag, tmp_path, verb, without, words, options
):
    if options == "--graph":
        pytest.importorskip("rclpy")

    def edit(name, data):
        sections = yaml.safe_load(data) if name == "parameters.yaml" else {}
        sections.pop(without, None)
        return yaml.safe_dump(sections).encode() if sections else None

    output = () if options != "--graph" else ("-o", tmp_path / "replay")
    found = verb("replay", rewritten(bag, tmp_path / "new", unchanged, edit), *options.split(), *output)
    # The commands alone need no map.
    assert (found.code == 0) == (without == "feedforward" and not options)
    assert found.code == 0 or (found.code == 1 and words in " ".join(found.err.split()))


def test_a_file_that_was_written_in_another_order_is_verified_as_it_was_recorded(bag, tmp_path, monkeypatch):
    there = rewritten_bag._messages(next(bag.glob("*.mcap")))
    half = len(there) // 2
    monkeypatch.setattr(rewritten_bag, "_messages", lambda _: there[half:] + there[:half])
    found = audit(rewritten(bag, tmp_path / "new", unchanged))
    assert found == audit(bag) and not found.unverified
