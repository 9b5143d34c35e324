"""Each verdict provoked on the simulated stage and in recordings, and the neighbours that stay in order."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import BAGS, SMC
from recorded_run import recorded_run
from surveys import one_run
from tiers import nightly

from straightcomp_ros.analysis import evaluation
from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.judged_motion import Left
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.bags import PARAMETERS_ATTACHMENT
from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.bags.recorded_nodes import recorded_parameters
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.cell.demonstration import Demonstration, DemonstrationFailed
from straightcomp_ros.cli import demo
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.offline import promise
from straightcomp_ros.offline.promise import promise_of
from straightcomp_ros.offline.starts import first_cycle
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.parameters.yaml_text import dump_yaml, load_yaml
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.timing.node_timing import HeldUp, Report, summarise

CYCLE = {"motion.stroke": 0.3, "motion.settle": 0.1, "motion.pause": 0.1}
SHORT = [word for name, value in CYCLE.items() for word in ("--set", f"stage.{name}={value}")]
GUIDE = "config/guide_synthetic.csv"


def parameters(**sections) -> dict[str, dict]:
    """Of a cycle of 0.3 m forward and back."""
    return {"driver": {}, "feedforward": {}, "controller": {}, "stage": CYCLE, **sections}


def verdict(**changes) -> Verdict:
    """On the first cycle, with changes NODE.NAME of the parameters, dots as in their names."""
    values = parameters()
    for name, value in changes.items():
        node, _, parameter = name.partition(".")
        values[node] = {**values[node], parameter: value}
    record, straightness = first_cycle(values)
    return verdict_of(judged_motion(record, straightness, by_node(values), straightness))


def survey(path: Path, deviation, length: float = 1.76, step: float = 0.01) -> str:
    x = np.linspace(0.0, length, round(length / step) + 1)
    write_survey(path, one_run(x, deviation(x)))
    return str(path)


WORKING = [
    {},
    {"stage.motion.stroke": 0.005},
    {"stage.motion.stroke": 1.76},
    {"stage.motion.speed": 1.0, "stage.motion.acceleration": 5.0, "stage.motion.stroke": 1.76},
    {"stage.encoder.y_resolution": 1e-9},
    {"stage.encoder.y_resolution": 1e-6},
    {"stage.drive.delay": 1.5},
    {"driver.simulated.initial_y": 1e-4},
    {"stage.rate": 4000},
    {"stage.rate": 10_000},
]


SLOW_JOG = {"stage.motion.stroke": 0.01, "stage.motion.speed": 0.001}
"""Its reference is slower than the rest speed."""
WEAK = {"stage.actuator.current_limit": 0.3}


@pytest.mark.parametrize(
    ("law", "changes", "expected"),
    [
        *(("smc_observer", changes, "in_order") for changes in (*WORKING, SLOW_JOG)),
        *((law, changes, "in_order") for law in ("linear", "smc") for changes in WORKING[:2]),
        *nightly((law, changes, "in_order") for law in ("linear", "smc") for changes in WORKING[2:]),
        # A loop that does not fit its machine.
        ("smc_observer", {"driver.simulated.truth.mass": 4.0}, "oscillates"),
        ("smc_observer", {"stage.drive.delay": 5.0}, "oscillates"),
        ("smc", {"stage.drive.delay": 3.0}, "oscillates"),
        ("smc", {"controller.control.smc.boundary_layer": 0.0}, "oscillates"),
        ("smc_observer", {"stage.motion.stroke": 1.76, "stage.rate": 500}, "oscillates"),
        ("smc_observer", {"driver.simulated.truth.mass": 1.33}, "in_order"),
        ("smc_observer", {"stage.drive.delay": 2.0}, "in_order"),
        # A platform that the law cannot bring back from its start, and others.
        ("smc_observer", {**WEAK, "driver.simulated.initial_y": 1e-3}, "at_stop"),
        ("smc_observer", {**WEAK, "driver.simulated.initial_y": 3e-4}, "in_order"),
        ("smc_observer", {"driver.simulated.initial_y": 1.2e-3, "stage.motion.settle": 1.0}, "in_order"),
        # A current limit, or a converter, that is too small to move the platform.
        *((law, {"stage.motion.stroke": 1.0, "stage.actuator.current_limit": 0.01}, "saturated") for law in LAWS),
        *((law, {"stage.motion.stroke": 1.0, "stage.drive.gain": 0.001}, "saturated") for law in LAWS),
        *((law, {"stage.actuator.current_limit": 0.03}, "in_order") for law in LAWS),
    ],
    ids=str,
)
def test_what_works_is_in_order_and_what_does_not_is_named_by_its_kind(law, changes, expected):
    # The paper's proportional law moves the platform within friction only on more than a few millimetres.
    if law == "linear" and changes.get("stage.motion.stroke") == 0.005:
        changes = {"stage.motion.stroke": 0.02}
    found = verdict(**{"controller.control.law": law, **changes})
    assert found.verdict == expected, found


@pytest.mark.parametrize("height, count", [(1e-6, 1e-8), (40e-6, 1e-6)])
def test_the_height_of_the_guide_does_not_matter(tmp_path, height, count):
    file = survey(tmp_path / "guide.csv", lambda x: height * np.sin(2.0 * np.pi * x / 0.5))
    files = {"stage.guide.file": file}
    for law in LAWS:
        found = verdict(**files, **{"controller.control.law": law, "stage.encoder.y_resolution": count})
        assert found.in_order, found


@pytest.mark.parametrize("law", ["smc_observer", *nightly(["linear", "smc"])])
def test_a_survey_of_another_guide_is_recognised(tmp_path, law):
    guide = load_map(MapParameters(file=GUIDE))
    others = {
        "another": lambda x: 9e-6 * np.sin(2.0 * np.pi * 3.3 * x / 1.76 + 1.0),
        "from the other end": lambda x: guide.deviations(1.76 - x),
        "other sign": lambda x: -guide.deviations(x),
    }
    whole = {"controller.control.law": law, "stage.motion.stroke": 1.76}
    for name, deviation in others.items():
        found = verdict(**whole, **{"feedforward.stage.guide.file": survey(tmp_path / f"{name}.csv", deviation)})
        assert found.verdict == "wrong_guide", name
    same = survey(tmp_path / "same.csv", lambda x: guide.deviations(x) + 0.06e-6 * np.sin(20.0 * x) + 5e-6 * x)
    assert verdict(**whole, **{"feedforward.stage.guide.file": same}).in_order


@pytest.mark.parametrize("truth", [True, False])
def test_a_survey_with_a_zero_that_is_off_is_found_by_the_truth_and_by_a_sensor(tmp_path, truth):
    guide = load_map(MapParameters(file=GUIDE))
    file = survey(tmp_path / "shifted.csv", lambda x: guide.deviations(x - 2e-3))
    values = parameters(feedforward={"stage.guide.file": file}, stage={"motion.stroke": 1.7})
    record, straightness = first_cycle(values)
    sensor = None
    if not truth:
        noise = np.random.default_rng(1).normal(0.0, 0.05e-6, record.x.size)
        sensor = guide.deviations(record.x) + noise
        sensor[::7] = np.nan
        record = replace(record, true_x=None, true_y=None, guide=None)
    found = verdict_of(judged_motion(record, straightness, by_node(values), straightness, sensor=sensor))
    assert found.verdict == "wrong_guide" and "shift its x by -2 mm" in found.reason, found
    if sensor is not None:
        own = straightness.deviations(record.x) + noise
        assert verdict_of(judged_motion(record, straightness, by_node(values), straightness, sensor=own)).in_order


def test_the_promise_is_that_of_the_description_and_not_of_the_machine_or_its_noisy_map(tmp_path):
    guide, random = load_map(MapParameters(file=GUIDE)), np.random.default_rng(1)
    file = survey(tmp_path / "noisy.csv", lambda x: guide.deviations(x) + random.normal(0.0, 0.3e-6, x.size), step=1e-3)
    values = parameters(feedforward={"stage.guide.file": file, "stage.guide.smooth": "none"})
    record, straightness = first_cycle({**values, "driver": {"simulated.truth.mass": 4.0}})
    found = promise_of(record, by_node(values), straightness)
    assert found.smooth.pp < 0.3e-6 < 1e-6 < found.as_mapped().pp
    first, most = found.largest(Left(0.0, 0.0)), found.largest(Left(1.0, 1.0))
    assert 0.0 < first.pp <= most.pp < 1e-6 and 0.0 < first.rms <= most.rms < 0.1e-6
    assert found.largest(first) == first
    # A rest of ten minutes between the strokes does not make them slower.
    turn, columns = record.motion.strokes[1].start, record.columns()
    columns |= {name: np.insert(of, turn, np.full(1_200_000, of[turn])) for name, of in columns.items()}
    columns["time"] = np.arange(columns["x"].size) * 5e-4
    assert promise_of(replace(record, **columns), by_node(values), straightness).smooth == found.smooth
    assert promise_of(record, {"driver": {}}, straightness) is promise_of(record, by_node(values), None) is None
    assert promise_of(record, {"controller": {"control.law": "another"}}, straightness) is None


def test_with_two_tables_and_a_coarse_x_the_promise_is_what_the_described_machine_leaves():
    values = parameters(stage=CYCLE | {"guide.direction": "both", "encoder.x_resolution": 1e-4})
    record, straightness = first_cycle(values)
    assert straightness.directed
    left = peak_to_peak(record.moving.true_error(straightness))
    assert promise_of(record, by_node(values), straightness).as_mapped().pp == pytest.approx(left, rel=1e-6)


def test_a_run_by_a_list_of_positions_has_the_promise_of_its_movements_wherever_the_list_is(tmp_path):
    (tmp_path / "positions.txt").write_text("0.1\n0.2\n0.3\n")
    by_list, in_steps = (
        parameters(stage=CYCLE | motion)
        for motion in ({"motion.file": str(tmp_path / "positions.txt"), "motion.stroke": 1.0}, {"motion.steps": 3})
    )
    record, straightness = first_cycle(by_list)
    (tmp_path / "positions.txt").unlink()
    promises = [promise_of(record, by_node(values), straightness).smooth.pp for values in (by_list, in_steps)]
    assert promises[0] == pytest.approx(promises[1], rel=0.2)


@pytest.mark.parametrize(
    ("made", "described", "found"),
    [
        # Described rests and steps that were not made take neither time nor memory. The ends of ramps count as rest.
        ({}, {"settle": 86400.0, "pause": 86400.0, "steps": 1000}, {"settle": 1.0, "pause": 0.51, "steps": 1}),
        ({"steps": 3}, {"steps": 3}, {"steps": 3, "pause": 0.5}),
        ({"pause": 20.0}, {"pause": 20.0}, {"pause": 20.0}),
        ({"pause": 60.0}, {"pause": 60.0}, {"pause": 20.0}),
        # Without a rest between them, steps are one stroke of the record, as is a stroke that was made without any.
        *(
            ({"steps": steps} | motion, {"steps": 10, "pause": 0.0}, {"steps": steps, "pause": 0.0})
            for steps in (1, 10)
            for motion in ({"pause": 0.0}, {"pause": 0.0, "speed": 0.02}, {"pause": 0.01, "stroke": 0.02})
        ),
        ({"start": 0.1, "stroke": 0.03, "steps": 3}, {"stroke": 1.0, "steps": 100}, {"stroke": 0.03, "steps": 3}),
        # A stage that goes backward first: as described, and elsewhere.
        ({"start": 2.0, "stroke": -0.3}, {"start": 2.0, "stroke": -0.3}, {"start": 2.0, "stroke": -0.3}),
        ({"start": 2.0, "stroke": -0.3}, {"stroke": -1.0}, {"start": 2.0, "stroke": -0.3}),
        # A motion that is as slow as one of a machine that creeps.
        ({"stroke": 0.004, "speed": 1e-4}, {}, {"stroke": 0.004, "speed": 1e-4}),
        # A list of near positions far from the start.
        ({"file": "0.25\n0.2505\n0.251\n0.2515\n"}, {"file": "unknown"}, {"stroke": 0.2515, "steps": 5}),
        # A trajectory that accelerates more than is described.
        ({"stroke": 0.2, "speed": 0.5, "acceleration": 2.0}, {}, {"stroke": 0.2, "speed": 0.5}),
        ({"stroke": 0.2, "speed": 0.5, "acceleration": 2.0}, {"jerk": 1.0}, {"stroke": 0.2, "speed": 0.5}),
        ({"stroke": 0.2, "jerk": 1.0}, {"jerk": 1.0}, {"stroke": 0.2, "acceleration": 0.2, "jerk": 1.0}),
    ],
)
def test_the_promised_motion_is_that_which_was_made(tmp_path, made, described, found):
    if "file" in made:
        (tmp_path / "positions.txt").write_text(made["file"])
        made = made | {"file": str(tmp_path / "positions.txt")}
    trajectory = Trajectory(forward_and_back(MotionParameters(**{"stroke": 0.3, **made})))
    stamps = np.arange(0, trajectory.end_ns, 500_000)
    x = trajectory.at(stamps)
    record = StrokeRecord(stamps * 1e-9, x, 0.0 * x, 0.0 * x, 0.0 * x, "law")
    motion = promise._motion(record, MotionParameters(**{"stroke": 0.3, **described}))
    for name, value in found.items():
        assert getattr(motion, name) == pytest.approx(value, rel=1e-3), name
    fastest = np.abs(Trajectory(forward_and_back(motion)).velocities).max()
    assert fastest == pytest.approx(np.abs(trajectory.velocities).max(), rel=0.03)


def test_a_motion_of_too_many_samples_has_no_promise(monkeypatch):
    values = parameters(stage=CYCLE | {"motion.stroke": 0.02})
    record, straightness = first_cycle(values)
    with monkeypatch.context() as patched:
        patched.setattr(promise, "MOST_SAMPLES", record.time.size // 2)
        assert promise_of(record, by_node(values), straightness) is None
    assert promise_of(record, by_node(values), straightness) is not None


@pytest.mark.parametrize(
    ("name", "verdict"), [("uncompensated", "in_order"), ("smc", "in_order"), ("cut_off", "interrupted")]
)
@pytest.mark.filterwarnings("ignore:.*was not finished")
def test_the_sample_bags_are_in_order_but_for_the_one_that_is_cut_off_in_motion(name, verdict, verb):
    ended = verb("evaluate", BAGS / name, "--json")
    found, warned = ended.json, int(verdict == "interrupted")
    assert (ended.code, found["verdict"]) == (verdict != "in_order", verdict) and found["reason"]
    assert ended.err.count("was not finished") == len(found["warnings"]) == warned


def recorded(folder: Path, stall: tuple[float, float] = (0.0, 0.0), kick: float = 0.0, **driver) -> Path:
    """A bag of a short cycle, with parameters of the ``driver``. In ``stall`` (s) nineteen of twenty samples are lost,
    and the platform is off by up to ``kick`` in m."""
    begin, end = stall

    def see(run, sample, truth, *answer):
        time = sample.stamp_ns * 1e-9
        if not begin < time < end:
            run.add(sample, truth, *answer)
        elif round(time * 2000.0) % 20 == 0:
            push = kick * math.sin(math.pi * (time - begin) / (end - begin))
            run.add(sample._replace(y=sample.y + push), truth._replace(y=truth.y + push), *answer)

    return recorded_run(folder, parameters(driver=driver), see)


@pytest.fixture(scope="module")
def harmless(tmp_path_factory) -> Path:
    return recorded(tmp_path_factory.mktemp("harmless") / "bag", stall=(1.0, 1.2))


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory) -> Path:
    return recorded(tmp_path_factory.mktemp("spoilt") / "bag", stall=(1.0, 1.2), kick=3e-6)


def judged(bag: Path) -> Verdict:
    found = evaluate_bag(bag)
    return verdict_of(judged_motion(found.record, found.record.reference, found.parameters, found.map, found.stalls))


def test_a_recording_that_a_stall_spoilt_is_starved_and_one_that_it_did_not_is_in_order(
    spoilt, harmless, tmp_path, verb
):
    assert judged(harmless).in_order and judged(recorded(tmp_path / "quiet")).in_order
    report = tmp_path / "report.html"
    found = verb("evaluate", spoilt, "--json", "--report", report)
    assert (found.code, found.json["verdict"]) == (1, "starved") and "not in order: starved" in found.err
    assert "Verdict: starved" in report.read_text(encoding="utf-8")


def test_a_run_in_lockstep_is_not_judged_by_the_clock_of_its_recording(tmp_path, monkeypatch):
    late = {"driver": [Report(3_600_000_000_000, {})]}
    monkeypatch.setattr(evaluation, "reports_in", lambda *_: late)
    monkeypatch.setattr(evaluation.interruption, "clock_jump", lambda samples: "the clock was set back")
    for lockstep in (False, True):
        bag = recorded(tmp_path / f"{lockstep}", lockstep=lockstep)
        assert (evaluate_bag(bag).partial() is None) == lockstep


def test_limits_alone_decide_the_exit_code_of_an_evaluation(spoilt, tmp_path, verb):
    for pp, code in ((10, 0), (1, 1)):
        (tmp_path / "limits.yaml").write_text(f"true_pp_um: {pp}\n")
        found = verb("evaluate", spoilt, "--limits", tmp_path / "limits.yaml", "--json")
        assert (found.code, found.json["verdict"]) == (code, "starved") and ("true_pp_um is" in found.err) == bool(code)


@pytest.mark.parametrize(("length", "expected"), [(0.25, "left_map"), (0.29, "in_order")])
def test_a_stage_beyond_a_survey_s_run_out_left_the_map_in_the_simulation_and_in_its_recording(
    tmp_path, verb, length, expected
):
    file = survey(tmp_path / "short.csv", load_map(MapParameters(file=GUIDE)).deviations, length)
    words = ["--set", f"feedforward.stage.guide.file={file}", "--bag", tmp_path / "bag"]
    assert verb("simulate", *SHORT, *words, "--json").json["verdict"] == judged(tmp_path / "bag").verdict == expected


HEAVY = [*SHORT, "--set", "driver.simulated.truth.mass=4"]


def test_simulate_marks_the_figures_of_a_run_that_is_not_in_order_and_fails(verb):
    code, printed, said = verb("simulate", *HEAVY)
    assert printed.count(" ! ") == 5 and "Verdict: oscillates" in printed
    assert (code, said) == (1, "straightcomp simulate: not in order: oscillates\n")
    code, printed, said = verb("simulate", *SHORT)
    assert " ! " not in printed and "Verdict: in order" in printed and (code, said) == (0, "")


def test_simulate_prints_the_verdict_on_cycles_and_starts_in_json(verb):
    code, found = (ended := verb("simulate", *HEAVY, "--json", "--strokes", "2")).code, ended.json
    assert (code, found["verdict"]) == (1, "oscillates") and found["reason"].startswith("cycle 2 of 2: ")
    assert [one["verdict"] for one in found["cycles"]] == ["oscillates"] * 2
    ended = verb("simulate", *HEAVY, "--json", "--starts", "2")
    assert ended.code == 1 and ended.json["reason"].startswith("start 2 of 2: ")
    assert verb("simulate", *SHORT, "--json", "--strokes", "2", "--law", "smc", "--learn").code == 0


def test_replay_fails_if_the_run_that_would_have_been_is_not_in_order(verb):
    ended = verb("replay", SMC, "--set", "driver.simulated.truth.mass=4", "--json")
    found = ended.json
    assert found["recorded"]["verdict"] == found["simulated_as_recorded"]["verdict"] == "in_order"
    assert ended.code == 1 and found["what_if"]["verdict"] == found["verdict"] == "oscillates"
    ended = verb("replay", SMC, "--law", "linear")
    assert ended.code == 0 and ended.out.count("in order: error") == 3


def test_the_board_of_a_recorded_machine_is_simulated_without_its_files(tmp_path, verb):
    def edit(name: str, data: bytes) -> bytes:
        tree = load_yaml(data) if name == PARAMETERS_ATTACHMENT else {}
        for node, section in tree.items():
            if node.endswith("driver"):
                section["ros__parameters"] |= files
        return dump_yaml(tree).encode() if tree else data

    files = {"hardware": "can", "can.dbc": "/nowhere/board.dbc"}
    files["simulated.truth.disturbances.force_file"] = "/nowhere/force.csv"
    recover(SMC, tmp_path / "bag", edit=edit)
    assert recorded_parameters(tmp_path / "bag", read_attachments(tmp_path / "bag"))["driver"].items() > files.items()
    with pytest.warns(UserWarning, match="/nowhere/force.csv"):
        found, whole = (verb("replay", bag, "--law", "linear", "--json") for bag in (tmp_path / "bag", SMC))
    assert found.code == whole.code == 0
    assert found.json["what_if"] == whole.json["what_if"]


def demonstration(bag, timing=None, verdict=None, killed=()):
    map_, found = load_map(MapParameters()), evaluate_bag(bag)
    figures = evaluate(found.record, map_)
    return Demonstration(bag, found, map_, figures, math.nan, timing or {}, verdict or judged(bag), list(killed))


@pytest.fixture
def demo_of(tmp_path, verb, monkeypatch):
    """``demo_of(outcome, *words, made="")``: how `demo` ends where its demonstration makes this folder, and then gives
    or raises the outcome."""

    def run(outcome, *words, made=""):
        def demonstrate(values, place, *_, **__):
            if made:
                (place / made).mkdir()
            if isinstance(outcome, BaseException):
                raise outcome
            return outcome

        monkeypatch.setattr(demo, "demonstrate", demonstrate)
        return verb("demo", "-o", tmp_path / "out", *words)

    return run


def test_a_demonstration_prints_its_domain_keeps_its_incidents_and_fails_if_a_node_had_to_be_killed(
    harmless, demo_of, tmp_path
):
    killed = "node 'driver' did not stop cleanly: signal SIGKILL"
    found = demo_of(demonstration(harmless, killed=[killed]), "--json", made="bag_incidents")
    assert found.code == 1 and found.err.endswith(f"{killed}\n")
    assert re.search(r"ROS_DOMAIN_ID=\d+ straightcomp view", found.err)
    assert (tmp_path / "out" / "bag_incidents").is_dir()


def test_an_interrupted_demonstration_says_where_its_recording_is(demo_of, tmp_path, verb):
    unfinished = tmp_path / "out" / "unfinished"
    found = demo_of(KeyboardInterrupt(), made="bag")
    assert found.code == 130 and str(unfinished) in found.err and (unfinished / "bag").is_dir()
    # A run that is refused is no next run.
    for words in (["--hardware", "can", "--lockstep"], ["--set", "stage.guide.file=/nowhere.csv"]):
        assert verb("demo", "-o", tmp_path / "out", *words).code == 2 and (unfinished / "bag").is_dir()


def test_an_incident_packed_after_the_end_of_a_demonstration_does_not_refuse_the_next(demo_of, tmp_path):
    incidents = tmp_path / "out" / "unfinished" / "bag_incidents"
    failed = DemonstrationFailed("cell: amplifier off", "")
    for _ in range(2):
        found = demo_of(failed, "--strict", made="bag_incidents")
        assert found.code == 1 and "amplifier off" in found.err
        (incidents / "2026_11_30-07_42_38_tripped.zip").touch()
    (incidents / "mine.zip").touch()
    assert demo_of(failed, "--strict", made="bag_incidents").code == 2


def test_a_starved_demonstration_fails_only_with_real_time_priority_or_if_asked_to(spoilt, harmless, demo_of):
    held = HeldUp(late_us=5e4, scheduling="FIFO 40")
    priority = dict.fromkeys(("driver", "feedforward", "controller"), replace(summarise([]), held_up=held))
    starved = "the servo works, the computer was busy\n"
    for bag, words, options, code, saw in (
        (harmless, [], {}, 0, "ROS 2 nodes moved"),
        (harmless, ["--lockstep"], {"timing": priority}, 0, "ROS 2 nodes moved"),
        (spoilt, [], {}, 0, starved),
        (spoilt, ["--strict"], {}, 1, starved),
        (spoilt, [], {"timing": priority}, 1, starved),
        (spoilt, [], {"verdict": Verdict("oscillates", "the loop oscillates")}, 1, "a run that failed"),
    ):
        found, printed, _ = demo_of(demonstration(bag, **options), *words)
        assert found == code and f"What you saw: {saw}" in printed and (" ! " in printed) == (bag is spoilt)
        assert ("Less accurate" in printed) == ("timing" in options and "--lockstep" not in words)


@pytest.mark.parametrize(
    ("cause", "words", "again"),
    [
        ("the driver got no CPU for 11 ms", [], True),
        ("the driver got no CPU for 11 ms", ["--strict"], False),
        ("the driver got no CPU for 11 ms", ["--hardware", "can"], False),
        ("", [], False),
    ],
)
def test_a_demonstration_that_lost_the_platform_for_want_of_a_cpu_runs_again_in_lockstep(
    harmless, tmp_path, verb, monkeypatch, cause, words, again
):
    result, lockstep = demonstration(harmless), []

    def demonstrate(values, *_, **__):
        lockstep.append(bool(values["driver"].get("lockstep")))
        if not lockstep[-1]:
            raise DemonstrationFailed("amplifier off in mid-cycle", cause)
        return result

    monkeypatch.setattr(demo, "demonstrate", demonstrate)
    found = verb("demo", "-o", tmp_path / "out", *words)
    assert lockstep == [False] + [True] * again
    assert found.code == (not again) and ("once more in lockstep" in found.err) == again
