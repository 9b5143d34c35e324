"""`straightcomp evaluate` on finished, unfinished and damaged bags."""

import math
import random
from collections import namedtuple
from unittest.mock import Mock

import pytest
from places import SMC
from recorded_run import recorded_run
from verbs import ran

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.cli import Terminated
from straightcomp_ros.contract import CONTROLLER_STATE, DISPLACEMENT, STREAMS, TRUTH
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.messages.cdr import joint_state
from straightcomp_ros.offline.simulation import Simulation

CYCLE = {"motion.stroke": 0.05, "motion.settle": 0.1, "motion.pause": 0.1}
OPTIONS = [word for name, value in CYCLE.items() for word in ("--set", f"stage.{name}={value}")]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """The bag of a simulated run, and its printed figures."""
    bag = tmp_path_factory.mktemp("bags") / "run"
    found = ran("simulate", "--bag", bag, "--json", *OPTIONS)
    assert found.code == 0, found.err
    return bag, found.json


@pytest.fixture
def bag(simulated):
    return simulated[0]


def test_its_figures_are_those_of_the_simulation_which_writing_a_bag_does_not_change(simulated, verb):
    bag, simulated = simulated
    assert verb("simulate", "--json", *OPTIONS).json == simulated
    evaluated = verb("evaluate", bag, "--json").json
    for name in simulated.keys() & evaluated.keys() - {"law", "samples"}:
        assert evaluated[name] == pytest.approx(simulated[name], abs=1e-6), name
    assert evaluated["law"] == simulated["law"] == ControlParameters().law
    assert [stroke["direction"] for stroke in evaluated["strokes"]] == ["forward", "backward"]
    assert (evaluated["lost_samples"], evaluated["lost_commands"]) == (0, 0)
    assert evaluated["latency_p50_us"] == pytest.approx(5e5 * simulated["delay_samples"] / 1e3)


def test_each_stream_of_a_simulated_bag_has_what_belongs_to_its_sample(tmp_path):
    command = namedtuple("command", ("current", *CONTROLLER_STATE.layout.columns[:-1]))
    width = len(CONTROLLER_STATE.layout.columns) - 1
    with SimulatedRun(tmp_path / "run", {}, 1.5) as run:
        for k in range(3):
            # The amplifier is on from the second sample on; the last one comes a period late.
            sample = Sample((0, 500_000, 1_500_000)[k], 0.1 * k, 0.2 * k, 0.3 * k if k else math.nan)
            truth = [0.4 * k + column for column in range(len(TRUTH.layout.columns))]
            run.add(sample, truth, (0.5 * k, 0.6 * k, 0.7 * k), command(0.8 + k, *[0.9 * k] * width), 1e-3 * k)
    streams = read_streams(tmp_path / "run", {stream.topic: stream.layout for stream in STREAMS})
    for stream in streams.values():
        assert stream.stamp.tolist() == stream.log_time.tolist()
        assert (stream.stamp - stream.stamp[0]).tolist() == [0, 500_000, 1_500_000] and stream.stamp[0] > 0
    driver = [column.tolist() for column in streams["driver_state"].columns.values()]
    # The command before has come, and is what the amplifier has been asked for.
    assert driver[0][1:] == pytest.approx([0.75e-3, 1.5e-3]) and math.isnan(driver[0][0])
    assert driver[1:] == [[0.0] * 3, [0.0, 0.8, 1.8], [0.0, 1.0, 1.0]]
    state = [column.tolist() for column in streams["controller_state"].columns.values()]
    assert state == [[0.0, 0.9, 1.8]] * width + [[0.0, 1e-3, 2e-3]]
    assert [column.tolist() for column in streams["command"].columns.values()] == [[0.8, 1.8, 2.8]]


@pytest.mark.parametrize(("stop", "left"), [(KeyboardInterrupt, False), (Terminated, False), (ValueError, True)])
def test_of_a_simulation_that_is_stopped_in_the_second_stroke_no_bag_is_left(tmp_path, verb, monkeypatch, stop, left):
    """Of one that fails the bag shows how."""
    whole, runs = Simulation.run, []

    def run(*given):
        if runs:
            raise stop
        runs.append(whole(*given))
        return runs[0]

    monkeypatch.setattr(Simulation, "run", run)
    assert verb("simulate", "--bag", tmp_path / "run", "--strokes", 2, *OPTIONS).code != 0 and runs
    assert (tmp_path / "run").exists() == left


@pytest.mark.parametrize("closing", [None, OSError("no space left"), KeyboardInterrupt()])
def test_a_folder_that_was_there_stays_without_a_bag_whatever_happens_when_a_simulation_is_stopped(
    tmp_path, monkeypatch, closing
):
    (tmp_path / "mine").mkdir()
    (tmp_path / "link").symlink_to("mine")
    with pytest.raises(type(closing or KeyboardInterrupt())), SimulatedRun(tmp_path / "link", {}, 1.0):
        if closing:
            monkeypatch.setattr(BagWriter, "close", Mock(side_effect=closing))
        raise KeyboardInterrupt
    assert (tmp_path / "link").is_symlink() and not list((tmp_path / "mine").iterdir())


@pytest.mark.parametrize(
    "name", ["bags.simulated_run.attach_parameters", "cli.simulate.working", "bags.writer.write_whole"]
)
def test_of_a_simulation_that_is_stopped_before_its_first_sample_or_behind_its_last_no_bag_is_left(
    tmp_path, verb, monkeypatch, name
):
    monkeypatch.setattr(f"straightcomp_ros.{name}", Mock(side_effect=KeyboardInterrupt))
    assert verb("simulate", "--bag", tmp_path / "run", *OPTIONS).code == 130 and not (tmp_path / "run").exists()


def test_a_topic_under_another_name_is_found_by_remap(bag, verb):
    assert verb("evaluate", bag, "--json", "--remap", "encoder:=/encoder").json["lost_samples"] == 0
    found = verb("evaluate", bag, "--remap", "encoder:=/machine/axes")
    assert found.code == 1 and "'/machine/axes'" in found.err and "it has /command" in found.err


def test_two_bags_are_put_side_by_side_and_it_is_said_if_one_of_them_is_uncompensated(bag, verb):
    found = verb("evaluate", bag, "--json", "--compare", bag).json
    assert found["compared_with"]["true_pp_um"] == found["true_pp_um"]
    found = verb("evaluate", SMC, "--compare", SMC.with_name("uncompensated"))
    assert found.code == 0 and "uncompensated is uncompensated" in found.err


@pytest.fixture(params=[DISPLACEMENT.layout, joint_state(["gauge"], position=["deviation"])], ids=["ours", "foreign"])
def survey(request, tmp_path):
    """The bag of a simulated run with a displacement sensor, and whether its joint has the name that is read."""
    values = {"driver": {}, "feedforward": {}, "controller": {}, "stage": CYCLE}
    layout = request.param
    bag = recorded_run(tmp_path / "bag", values, sensor=lambda _, truth: truth.guide_deviation, layout=layout)
    return bag, layout is DISPLACEMENT.layout


def test_the_table_of_the_straightness_names_what_measured_the_guide(survey, verb):
    bag, known = survey
    sensor = [(("--sensor-uncertainty", "0.01"), "sensor", "map")] if known else []
    for words, by, other in [((), "map", "sensor"), *sensor]:
        (title,) = (line for line in verb("evaluate", bag, *words).out.splitlines() if "(k = 2)" in line)
        assert by in title and other not in title


def test_a_sensor_that_cannot_be_read_is_left_out_with_a_warning(survey, verb):
    bag, known = survey
    found = verb("evaluate", bag, "--json")
    assert found.code == 0 and found.json["lost_samples"] == 0 and ("'/displacement'" in found.err) is not known
    # Where it is asked for, the map does not take its place.
    found = verb("evaluate", bag, "--json", "--sensor-uncertainty", "0.01")
    assert (found.code, bool(found.out)) == ((0, True) if known else (1, False))
    assert ("readings on 'displacement'" in found.err) is not known


def test_where_no_stroke_is_stated_by_a_sensor_the_other_figures_are_and_a_note_says_so(bag, tmp_path, verb):
    runs = []
    # Some 280 samples a stroke, and some 1,000.
    for stroke in (0.001, 0.0125):
        values = {"driver": {}, "feedforward": {}, "controller": {}, "stage": CYCLE | {"motion.stroke": stroke}}
        runs.append(recorded_run(tmp_path / f"{stroke}", values, sensor=lambda _, truth: truth.guide_deviation))
    short, measured = runs
    # Of the other bag nothing is asked but to be compared: it may have no sensor.
    for first, other in ((short, measured), (measured, bag)):
        found = verb("evaluate", first, "--compare", other, "--json", "--sensor-uncertainty", "0.01")
        assert (found.code, found.json["verdict"], found.err.count("no straightness is stated")) == (0, "in_order", 1)
        of_both = found.json["straightness"], found.json["compared_with"]["straightness"]
        assert [bool(one) for one in of_both] == [first is measured, other is measured]


def test_no_file_however_bad_ends_in_a_traceback(bag, tmp_path, verb):
    content = (bag / "run_0.mcap").read_bytes()
    source = random.Random(2)
    path = tmp_path / "bad.mcap"
    noise = [source.randbytes(3000), b"", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + source.randbytes(3000)]
    for _ in range(25):
        changed = bytearray(content[: source.choice([len(content), source.randrange(len(content))])])
        for _ in range(source.randrange(1, 20)):
            changed[source.randrange(len(changed))] = source.randrange(256)
        noise.append(bytes(changed))
    for bad in noise:
        path.write_bytes(bad)
        found = verb("evaluate", path, "--json")
        if found.code:
            assert found.code in (1, 2) and "evaluate: " in found.err
            assert not found.out or found.json["verdict"] in ("interrupted", "clock_jumped")
        else:
            assert found.err.count("was not finished") == 1 or found.json["lost_samples"] == 0
