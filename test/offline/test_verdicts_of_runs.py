"""Each verdict provoked on the simulated stage and in recordings, and the neighbours that stay in order."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiers import nightly

from straightcomp_ros.analysis import evaluation
from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.judged_motion import Left
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cell.demonstration import Demonstration, DemonstrationFailed
from straightcomp_ros.cli import demo
from straightcomp_ros.cli.main import main
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.promise import promise_of
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import first_cycle
from straightcomp_ros.parameters.node_parameters import by_node
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from straightcomp_ros.straightness.survey import Run, Survey, write_survey
from straightcomp_ros.timing.node_timing import HeldUp, Report, summarise

BAGS = Path(__file__).resolve().parents[2] / "bags"
CYCLE = {"motion.stroke": 0.3, "motion.settle": 0.1, "motion.pause": 0.1}
SHORT = [word for name, value in CYCLE.items() for word in ("--set", f"stage.{name}={value}")]
GUIDE = "config/guide_synthetic.csv"


def verdict(**changes) -> Verdict:
    """On the first cycle, 0.3 m forward and back, with changes NODE.NAME of the parameters, dots as in their names."""
    values: dict[str, dict] = {"driver": {}, "feedforward": {}, "controller": {}, "stage": dict(CYCLE)}
    for name, value in changes.items():
        node, _, parameter = name.partition(".")
        values[node][parameter] = value
    record, straightness = first_cycle(values)
    return verdict_of(judged_motion(record, straightness, by_node(values), straightness))


def survey(path: Path, deviation, length: float = 1.76, step: float = 0.01) -> str:
    x = np.linspace(0.0, length, round(length / step) + 1)
    write_survey(path, Survey((Run("1", "forward", x, deviation(x)),)))
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


@pytest.mark.parametrize(
    ("law", "changes"),
    [
        *(("smc_observer", changes) for changes in WORKING),
        *(("linear", changes) for changes in WORKING[:2]),
        *(("smc", changes) for changes in WORKING[:2]),
        *nightly((law, changes) for law in ("linear", "smc") for changes in WORKING[2:]),
    ],
    ids=str,
)
def test_what_works_is_in_order(law, changes):
    # The paper's proportional law moves the platform within friction only on more than a few millimetres.
    if law == "linear" and changes.get("stage.motion.stroke") == 0.005:
        changes = {"stage.motion.stroke": 0.02}
    found = verdict(**{"controller.control.law": law, **changes})
    assert found.in_order, found


def test_a_jog_at_a_millimetre_a_second_is_followed_though_its_reference_is_slower_than_rest_speed():
    found = verdict(**{"stage.motion.stroke": 0.01, "stage.motion.speed": 0.001})
    assert found.in_order, found


@pytest.mark.parametrize("height, count", [(1e-6, 1e-8), (40e-6, 1e-6)])
def test_the_height_of_the_guide_does_not_matter(tmp_path, height, count):
    file = survey(tmp_path / "guide.csv", lambda x: height * np.sin(2.0 * np.pi * x / 0.5))
    files = {"stage.guide.file": file}
    for law in LAWS:
        found = verdict(**files, **{"controller.control.law": law, "stage.encoder.y_resolution": count})
        assert found.in_order, found


@pytest.mark.parametrize(
    "changes, expected",
    [
        # A loop that does not fit its machine.
        ({"driver.simulated.truth.mass": 4.0}, "oscillates"),
        ({"stage.drive.delay": 5.0}, "oscillates"),
        ({"controller.control.law": "smc", "stage.drive.delay": 3.0}, "oscillates"),
        ({"controller.control.law": "smc", "controller.control.smc.boundary_layer": 0.0}, "oscillates"),
        ({"stage.motion.stroke": 1.76, "stage.rate": 500}, "oscillates"),
        ({"driver.simulated.truth.mass": 1.33}, "in_order"),
        ({"stage.drive.delay": 2.0}, "in_order"),
        # A platform that the law cannot bring back from its start, and others.
        ({"stage.actuator.current_limit": 0.3, "driver.simulated.initial_y": 1e-3}, "at_stop"),
        ({"stage.actuator.current_limit": 0.3, "driver.simulated.initial_y": 3e-4}, "in_order"),
        ({"driver.simulated.initial_y": 1.2e-3, "stage.motion.settle": 1.0}, "in_order"),
    ],
    ids=str,
)
def test_a_loop_that_does_not_fit_oscillates_and_a_platform_that_cannot_come_back_is_at_its_stop(changes, expected):
    assert verdict(**changes).verdict == expected


def test_a_current_limit_or_a_converter_too_small_to_move_the_platform_saturates():
    for law in LAWS:
        for weak in ({"stage.actuator.current_limit": 0.01}, {"stage.drive.gain": 0.001}):
            found = verdict(**{"controller.control.law": law, "stage.motion.stroke": 1.0, **weak})
            assert found.verdict == "saturated", found
        found = verdict(**{"controller.control.law": law, "stage.actuator.current_limit": 0.03})
        assert found.in_order, found


def test_a_stage_beyond_a_survey_s_run_out_left_the_map(tmp_path):
    guide = load_map(MapParameters(file=GUIDE))
    for length, expected in ((0.25, "left_map"), (0.29, "in_order")):
        file = survey(tmp_path / f"{length}.csv", guide.deviations, length)
        assert verdict(**{"feedforward.stage.guide.file": file}).verdict == expected


@pytest.mark.parametrize("law", LAWS)
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
    values = {
        "driver": {},
        "feedforward": {"stage.guide.file": file},
        "controller": {},
        "stage": {"motion.stroke": 1.7},
    }
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
    followed = {"stage.guide.file": file, "stage.guide.smooth": "none"}
    values = {"driver": {}, "feedforward": followed, "controller": {}, "stage": dict(CYCLE)}
    record, straightness = first_cycle({**values, "driver": {"simulated.truth.mass": 4.0}})
    found = promise_of(record, by_node(values), straightness)
    assert found.smooth.pp < 0.3e-6 < 1e-6 < found.as_mapped().pp
    first, most = found.largest(Left(0.0, 0.0)), found.largest(Left(1.0, 1.0))
    assert 0.0 < first.pp <= most.pp < 1e-6 and 0.0 < first.rms <= most.rms < 0.1e-6
    assert found.largest(first) == first
    assert promise_of(record, {"driver": {}}, straightness) is promise_of(record, by_node(values), None) is None
    assert promise_of(record, {"controller": {"control.law": "another"}}, straightness) is None


def test_a_run_without_compensation_is_in_order(tmp_path):
    flat = survey(tmp_path / "flat.csv", lambda x: 0.011e-6 * x / 1.76)
    found = verdict(**{"feedforward.stage.guide.file": flat, "stage.motion.stroke": 1.76})
    assert found.in_order and "uncompensated" in found.reason


@pytest.mark.parametrize(
    ("name", "verdict"), [("uncompensated", "in_order"), ("smc", "in_order"), ("cut_off", "interrupted")]
)
@pytest.mark.filterwarnings("ignore:.*was not finished")
def test_the_sample_bags_are_in_order_but_for_the_one_that_is_cut_off_in_motion(name, verdict, capsys):
    assert main(["evaluate", str(BAGS / name), "--json"]) == (verdict != "in_order")
    printed = capsys.readouterr()
    found, warned = json.loads(printed.out), int(verdict == "interrupted")
    assert found["verdict"] == verdict and found["reason"]
    assert printed.err.count("was not finished") == len(found["warnings"]) == warned


def recorded(folder: Path, stall: tuple[float, float] = (0.0, 0.0), kick: float = 0.0, **driver) -> Path:
    """A bag of a short cycle, with parameters of the ``driver``. In ``stall`` (s) nineteen of twenty samples are lost,
    and the platform is off by up to ``kick`` in m."""
    values = {"driver": driver, "feedforward": {}, "controller": {}, "stage": dict(CYCLE)}
    simulation = Simulation(values)
    begin, end = stall
    with SimulatedRun(folder, by_node(values), simulation.delay) as bag:

        def add(sample, truth, *answer):
            time = sample.stamp_ns * 1e-9
            if not begin < time < end:
                bag.add(sample, truth, *answer)
            elif round(time * 2000.0) % 20 == 0:
                push = kick * math.sin(math.pi * (time - begin) / (end - begin))
                bag.add(sample._replace(y=sample.y + push), truth._replace(y=truth.y + push), *answer)

        simulation.run(observe=add)
    return folder


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
    spoilt, harmless, tmp_path, capsys
):
    assert judged(harmless).in_order and judged(recorded(tmp_path / "quiet")).in_order
    report = tmp_path / "report.html"
    assert main(["evaluate", str(spoilt), "--json", "--report", str(report)]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out)["verdict"] == "starved" and "not in order: starved" in captured.err
    assert "Verdict: starved: the servo works, the computer was busy: " in report.read_text(encoding="utf-8")


def test_a_run_in_lockstep_is_not_judged_by_the_clock_of_its_recording(tmp_path, monkeypatch):
    late = {"driver": [Report(3_600_000_000_000, {})]}
    monkeypatch.setattr(evaluation, "reports_in", lambda *_: late)
    monkeypatch.setattr(evaluation.interruption, "clock_jump", lambda samples: "the clock was set back")
    for lockstep in (False, True):
        bag = recorded(tmp_path / f"{lockstep}", lockstep=lockstep)
        assert (evaluate_bag(bag).partial() is None) == lockstep


def test_limits_alone_decide_the_exit_code_of_an_evaluation(spoilt, tmp_path, capsys):
    limits = tmp_path / "limits.yaml"
    for pp, code in ((10, 0), (1, 1)):
        limits.write_text(f"true_pp_um: {pp}\n")
        assert main(["evaluate", str(spoilt), "--limits", str(limits), "--json"]) == code
        printed = capsys.readouterr()
        assert json.loads(printed.out)["verdict"] == "starved" and ("true_pp_um is" in printed.err) == bool(code)
    limits.write_text("true_pp: 1\n")
    assert main(["evaluate", str(spoilt), "--limits", str(limits)]) == 2


def test_an_attached_survey_that_is_too_short_shows_in_the_recording(tmp_path):
    guide = load_map(MapParameters(file=GUIDE))
    file = survey(tmp_path / "short.csv", guide.deviations, 0.25)
    options = [*SHORT, "--set", f"feedforward.stage.guide.file={file}", "--bag", str(tmp_path / "bag"), "--json"]
    assert main(["simulate", *options]) == 1
    assert judged(tmp_path / "bag").verdict == "left_map"


def test_simulate_marks_the_figures_of_a_run_that_is_not_in_order_and_fails(capsys):
    heavy = [*SHORT, "--set", "driver.simulated.truth.mass=4"]
    assert main(["simulate", *heavy]) == 1
    captured = capsys.readouterr()
    assert captured.out.count(" ! ") == 5 and "Verdict: oscillates: the loop oscillates at" in captured.out
    assert captured.err == "straightcomp simulate: not in order: oscillates\n"
    assert main(["simulate", *SHORT]) == 0
    captured = capsys.readouterr()
    assert " ! " not in captured.out and "Verdict: in order: error" in captured.out and captured.err == ""


def test_simulate_prints_the_verdict_on_cycles_and_starts_in_json(capsys):
    heavy = [*SHORT, "--set", "driver.simulated.truth.mass=4", "--json"]
    assert main(["simulate", *heavy, "--strokes", "2"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "oscillates" and found["reason"].startswith("cycle 2 of 2: the loop oscillates")
    assert [one["verdict"] for one in found["cycles"]] == ["oscillates"] * 2
    assert main(["simulate", *heavy, "--starts", "2"]) == 1
    assert json.loads(capsys.readouterr().out)["reason"].startswith("start 2 of 2: ")
    assert main(["simulate", *SHORT, "--strokes", "2", "--law", "smc", "--learn"]) == 0


def test_replay_fails_if_the_run_that_would_have_been_is_not_in_order(capsys):
    bag = str(BAGS / "smc")
    assert main(["replay", bag, "--set", "driver.simulated.truth.mass=4", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["recorded"]["verdict"] == found["simulated_as_recorded"]["verdict"] == "in_order"
    assert found["what_if"]["verdict"] == found["verdict"] == "oscillates"
    assert main(["replay", bag, "--law", "linear"]) == 0
    assert capsys.readouterr().out.count("in order: error") == 3


@pytest.fixture
def demonstrated(tmp_path, capsys, monkeypatch):
    """``demonstrated(bag, *words, timing=, verdict=, killed=)``: exit code, standard output and error of a
    demonstration that recorded this bag."""

    def run(bag, *words, timing=None, verdict=None, killed=()):
        map_, found = load_map(MapParameters()), evaluate_bag(bag)
        figures = evaluate(found.record, map_)
        result = Demonstration(bag, found, map_, figures, math.nan, timing or {}, verdict or judged(bag), list(killed))
        monkeypatch.setattr(demo, "demonstrate", lambda *_, **__: result)
        code = main(["demo", "-o", str(tmp_path / "out"), *words])
        return code, *capsys.readouterr()

    return run


def test_a_demonstration_prints_its_domain_and_fails_if_a_node_had_to_be_killed(harmless, demonstrated):
    killed = "node 'driver' did not stop cleanly: signal SIGKILL"
    code, _, said = demonstrated(harmless, "--json", killed=[killed])
    assert code == 1 and re.search(r"ROS_DOMAIN_ID=\d+ straightcomp view", said) and said.endswith(f"{killed}\n")


def test_an_interrupted_demonstration_says_where_its_recording_is(tmp_path, capsys, monkeypatch):
    def demonstrate(values, place, *_, **__):
        (place / "bag").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "demonstrate", demonstrate)
    assert main(["demo", "-o", str(tmp_path)]) == 130
    assert f"interrupted; what it had made is in {tmp_path / 'unfinished'}" in capsys.readouterr().err
    assert (tmp_path / "unfinished" / "bag").is_dir()


def test_a_starved_demonstration_fails_only_with_real_time_priority_or_if_asked_to(spoilt, harmless, demonstrated):
    held = HeldUp(scheduling="FIFO 40")
    priority = dict.fromkeys(("driver", "feedforward", "controller"), replace(summarise([]), held_up=held))
    starved = "the servo works, the computer was busy\n"
    for bag, words, options, code, saw in (
        (harmless, [], {}, 0, "ROS 2 nodes moved"),
        (spoilt, [], {}, 0, starved),
        (spoilt, ["--strict"], {}, 1, starved),
        (spoilt, [], {"timing": priority}, 1, starved),
        (spoilt, [], {"verdict": Verdict("oscillates", "the loop oscillates")}, 1, "a run that failed"),
    ):
        found, printed, _ = demonstrated(bag, *words, **options)
        assert found == code and f"What you saw: {saw}" in printed and (" ! " in printed) == (bag is spoilt)


def test_a_demonstration_that_lost_the_platform_for_want_of_a_cpu_runs_again_in_lockstep(
    harmless, tmp_path, capsys, monkeypatch
):
    map_, found, runs, causes = load_map(MapParameters()), evaluate_bag(harmless), [], []
    result = Demonstration(harmless, found, map_, evaluate(found.record, map_), math.nan, {}, judged(harmless))

    def demonstrate(values, *_, **__):
        runs.append(bool(values["driver"].get("lockstep")))
        if not runs[-1]:
            raise DemonstrationFailed("amplifier off in mid-cycle", causes[-1])
        return result

    monkeypatch.setattr(demo, "demonstrate", demonstrate)
    words = ["demo", "-o", str(tmp_path / "out")]
    for cause, more, code, tried in (
        ("the driver got no CPU for 11 ms", [], 0, [False, True]),
        ("the driver got no CPU for 11 ms", ["--strict"], 1, [False]),
        ("the driver got no CPU for 11 ms", ["--hardware", "can"], 1, [False]),
        ("", [], 1, [False]),
    ):
        runs.clear()
        causes.append(cause)
        assert main([*words, *more]) == code and runs == tried
        assert ("once more in lockstep" in capsys.readouterr().err) == (code == 0)
