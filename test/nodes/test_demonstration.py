"""A demonstration of the whole graph, what ends it early, and the proof that live and offline are one code."""

import itertools
import math
import os
import shutil
import signal

import numpy as np
import pytest
from places import SMC
from tiers import nightly
from waiting import comes_true

from straightcomp_ros.bags import BagError
from straightcomp_ros.cell import demonstration
from straightcomp_ros.cell.demonstration import DemonstrationFailed, demonstrate
from straightcomp_ros.cell.launcher import RECORDED, Graph
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.audit import audit
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.straightness.survey import write_survey
from trials.noise import Kind, surveyed

pytestmark = pytest.mark.keeps_time

TRIGGERS = ("sample", "timer", "composed")
EVERYDAY = [("smc_observer", "composed")]


@pytest.mark.live
@pytest.mark.parametrize(
    ("law", "trigger"),
    [*EVERYDAY, *nightly(one for one in itertools.product(LAWS, TRIGGERS) if one not in EVERYDAY)],
)
def test_a_live_stroke_is_recorded_compensated_and_audited_with_each_law_and_trigger(
    tmp_path, short_cycle, law, trigger
):
    composed = trigger == "composed"
    short_cycle["controller"].update({"trigger": "sample" if composed else trigger, "control.law": law})
    seen = []
    result = demonstrate(short_cycle, tmp_path, progress=seen.append, composed=composed)
    figures, record = result.figures(), result.evaluation.record
    assert figures["law"] == law
    assert figures["expected_samples"] >= 2000 * 3
    assert figures["lost_samples"] == figures["expected_samples"] - figures["received_samples"]
    # A machine that is busy with other things may drop some and disturb some; none does so most of the time.
    assert figures["lost_samples"] < 0.05 * figures["expected_samples"]
    assert np.median(np.abs(record.r - record.y)) < (0.2e-6 if law == "smc_observer" else 0.5e-6) < np.ptp(record.r)
    assert 0 < figures["latency_p50_us"] <= figures["latency_p99_us"]
    for node in RECORDED:
        timing = figures["timing"][node]
        if math.isnan(timing["rate_hz"]):
            # In so short a cycle a late report may leave a node with less than two, and so without a rate.
            assert node != "driver"
            continue
        assert 1000 < timing["rate_hz"] < 2500 and timing["overruns"] >= 0
        late = timing["timer_error_us"]
        # In one process the driver's loop does the cycles of the two others: it alone can be late.
        if composed and node in ("feedforward", "controller"):
            assert math.isnan(late["max"])
        else:
            assert 0 <= late["p50"] <= late["p99"] <= late["p999"] <= late["max"]
    in_diagnostics = result.timing["driver"].latency.percentiles_us([50])[0]
    # Of other samples than the record's: a host that is busy for a part of them makes the medians differ.
    assert 0.25 < in_diagnostics / figures["latency_p50_us"] < 4.0
    assert seen == sorted(seen) and seen[-1] == 1.0
    found = audit(result.bag)
    assert found.passed and found.commands > 0.5 * figures["expected_samples"]


def test_more_strokes_than_fit_one_trajectory_are_refused_before_anything_starts(tmp_path, short_cycle):
    short_cycle["stage"]["motion.steps"], short_cycle["cell"]["strokes"] = 100, 33
    with pytest.raises(ParameterError, match="parameter 'strokes': 33 "):
        demonstrate(short_cycle, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    # A client of the gateway moves the stage by one movement after the other.
    assert demonstration.planned(short_cycle, 33)[0] > 60.0


@pytest.mark.parametrize("cycle_ms", [500, 2000])
def test_a_board_on_the_hub_may_say_its_state_as_seldom_as_its_file_says(tmp_path, cycle_ms):
    text = share_path("config/board_motorola.dbc").read_text()
    (tmp_path / "board_motorola.dbc").write_text(text.replace("BO_ 801 5;", f"BO_ 801 {cycle_ms};"))
    stage = shutil.copy(share_path("config/board_motorola.yaml"), tmp_path)
    values = shipped_parameters(stage=stage)
    values["driver"] |= demonstration.on_hub(values, "bus")
    can = node_parameters("driver", values).can
    # The state is on every other page.
    assert min(can.heartbeat_timeout, can.answer_timeout) > 4e-3 * cycle_ms


@pytest.mark.live
@pytest.mark.parametrize("victim", nightly(["driver", "logger"]))
def test_a_node_that_dies_in_mid_stroke_ends_the_demonstration_with_its_name(
    tmp_path, short_cycle, victim, monkeypatch
):
    graphs = []
    start = Graph.start

    def remember(self, name, *arguments, **options):
        process = start(self, name, *arguments, **options)
        graphs.append((name, process))
        return process

    monkeypatch.setattr(Graph, "start", remember)
    usable, affinities = os.sched_getaffinity(0), []

    def kill_when_moving(fraction):
        if fraction <= 0.3:
            affinities.append(os.sched_getaffinity(0))
        else:
            for name, process in graphs:
                if name == victim and process.poll() is None:
                    process.send_signal(signal.SIGKILL)

    with pytest.raises(DemonstrationFailed, match=rf"'{victim}'.*SIGKILL"):
        demonstrate(short_cycle, tmp_path, progress=kill_when_moving)
    assert all(process.poll() is not None for _, process in graphs)
    # The shipped driver keeps other programs off its CPU, and no longer than it lives.
    assert set(map(frozenset, affinities)) == {frozenset(usable - {max(usable)} or usable)}
    assert comes_true(lambda: os.sched_getaffinity(0) == usable, 10.0)


def test_strokes_of_the_gateway_are_whole_without_settling_times_between_them(tmp_path, short_cycle):
    # By its pauses ten of them take as long as the one in the bag.
    short_cycle["stage"].update({"motion.stroke": 1e-3, "motion.pause": 0.03})
    shutil.copytree(SMC, tmp_path / "bag")
    assert demonstration.judged(short_cycle, tmp_path, opcua_strokes=10).bag == tmp_path / "bag"
    with pytest.raises(DemonstrationFailed, match="is short"):
        demonstration.judged(short_cycle, tmp_path, opcua_strokes=20)


def test_a_demonstration_without_a_bag_fails_with_the_reason(tmp_path, short_cycle, monkeypatch):
    monkeypatch.setattr(demonstration, "run_cycle", lambda *arguments, **options: None)
    with pytest.raises(DemonstrationFailed, match=str(tmp_path)) as failure:
        demonstrate(short_cycle, tmp_path)
    assert isinstance(failure.value.__cause__, BagError)


def simulated_and_live(values, offline, folder, composed=False):
    """The run of the graph in lockstep, which equals that of the simulation ``offline`` to the last bit."""
    live = demonstrate(values, folder, composed=composed).evaluation
    assert live.expected_samples == live.received_samples == len(offline.x)
    for column in ("x", "y", "r", "current", "true_x", "true_y", "guide"):
        np.testing.assert_array_equal(getattr(live.record, column), getattr(offline, column), err_msg=column)
    return live


@pytest.mark.parametrize(
    ("law", "delay", "composed"),
    [
        # Each node in a process of its own is in `test_player.py`.
        ("smc_observer", 0.5, True),
        *nightly(
            one for one in itertools.product(LAWS, (0.5, 1.2), (False, True)) if one != ("smc_observer", 0.5, True)
        ),
    ],
)
def test_the_graph_in_lockstep_equals_the_simulation_to_the_last_bit(tmp_path, in_lockstep, law, delay, composed):
    in_lockstep["controller"]["control.law"] = law
    # The delay is the one that is described; strokes begin where they are described to, too.
    start = 0.7 if composed else 0.0
    in_lockstep["stage"].update({"drive.delay": delay, "uncertainty.longest_delay": 1.0, "motion.start": start})
    if directed := composed or delay > 1.0:
        # A map with two tables, 0.2 µm apart.
        file = str(tmp_path / "survey.csv")
        write_survey(file, surveyed(10e-3, 25e-9, Kind(hysteresis=30e-6)))
        in_lockstep["stage"]["guide.file"] = in_lockstep["driver"]["simulated.truth.guide"] = file
    offline = Simulation(in_lockstep).run()
    live = simulated_and_live(in_lockstep, offline, tmp_path, composed)
    assert live.record.law == law and live.map.directed is live.record.reference.directed is directed
    assert audit(tmp_path / "bag").passed
    assert np.ptp(offline.current) > 0.005  # it did work for its result


@pytest.mark.nightly
def test_the_graph_learns_in_lockstep_what_the_simulation_learns(tmp_path, in_lockstep):
    in_lockstep["controller"].update({"control.law": "linear", "learning.learn": True})
    here, there = tmp_path / "offline.csv", tmp_path / "live.csv"
    in_lockstep["controller"]["learning.file"] = str(here)
    first = Simulation(in_lockstep)
    bare = first.run()
    first.run()
    first.save_learning()
    shutil.copy(here, there)
    again = Simulation(in_lockstep)
    offline = again.run()
    again.save_learning()
    in_lockstep["controller"]["learning.file"] = str(there)
    simulated_and_live(in_lockstep, offline, tmp_path)
    assert there.read_bytes() == here.read_bytes()
    assert (offline.current != bare.current).any()  # what was learned was applied
