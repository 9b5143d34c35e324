"""A recorded bag in the real graph, which reaches no machine and changes nothing that it learned."""

from pathlib import Path

import pytest
from parameters_of_tests import short_parameters
from participant import Participant, subscribe
from rclpy.time import Time
from recorded_run import recorded_run
from rewritten_bag import rewritten
from rosgraph_msgs.msg import Clock

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.contract import CLOCK, COMMAND, ENCODER, POSITION_EVERY
from straightcomp_ros.offline.graph_replay import replay_through_graph
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.runtime.runner import EXIT_FAILURE
from straightcomp_ros.runtime.streams import stream_publisher, stream_qos

TEXTS = {
    *("stage.name", "stage.serial", "stage.motion.file", "stage.guide.file", "stage.guide.reference"),
    *("stage.guide.smooth", "realtime.cpus", "learning.file"),
}
"""Parameters of the played nodes that are free texts: of them only learning.file names a file that a node writes, and
stage.guide.file one that it reads, for which the replay has the bag's. stage.motion.file is for who moves the stage."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return recorded_run(tmp_path_factory.mktemp("recorded") / "run", short_parameters())


def test_the_nodes_answer_played_samples_as_they_were_recorded_to_the_bit(run, in_lockstep, tmp_path):
    found = replay_through_graph(run, tmp_path / "replay")
    assert found.different == 0
    # A busy machine may lose some on the way; whatever comes back must be the same.
    assert found.equal > 0.5 * found.samples


def test_the_time_of_the_samples_is_on_the_clock_and_a_pause_of_the_recording_is_not_waited_out(run, single, tmp_path):
    times, night = [], 8 * 3600 * 10**9
    later = lambda at: at + night * (at > 10**9)  # noqa: E731
    paused = rewritten(run, tmp_path / "paused", lambda _, at, numbers: (later(at), numbers, later(at)))
    with Participant("listener") as listener:
        listener.node.create_subscription(
            Clock, CLOCK, lambda message: times.append(Time.from_msg(message.clock).nanoseconds), stream_qos()
        )
        subscribe(listener.node, ENCODER, lambda stamp_ns, _: None)
        single.start("player", {"bag": str(paused), "subscribers": 1, "clock": True, "speed": 4.0})
        listener.until(lambda: len(times) >= 20 and times[-1] > night)
    # The clock may be connected after the first samples, and a busy machine may lose some of its messages.
    ticks = read_streams(paused, {ENCODER.topic: ENCODER.layout})[ENCODER.topic].stamp[::POSITION_EVERY]
    assert set(times) <= set(ticks.tolist()) and times == sorted(set(times))


def test_no_sample_is_played_where_another_node_publishes_samples(run, single):
    with Participant("machine") as machine:
        came = []
        subscribe(machine.node, ENCODER, lambda stamp_ns, _: came.append(stamp_ns))
        publisher = stream_publisher(machine.node, ENCODER)
        given = {"bag": str(run), "subscribers": 1}
        assert single.start("player", {**given, "start_timeout": 1.0}).wait(120) == EXIT_FAILURE
        assert not came
        # One that ends meanwhile, or was killed and is forgotten, is waited for.
        log = single.log("player")
        before = log.stat().st_size
        single.start("player", {**given, "start_timeout": 110.0})
        machine.until(lambda: "1 other publisher" in log.read_text()[before:])
        assert not came
        machine.node.destroy_publisher(publisher)
        machine.until(lambda: came)


def test_a_node_of_a_replay_has_no_other_parameter_that_names_a_file():
    for node in ("feedforward", "controller"):
        found = {one.name for one in declarations(NODE_PARAMETERS[node]) if one.kind is str and not one.choices}
        assert found <= TEXTS, node


def content():
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


@pytest.mark.nightly
@pytest.mark.live
def test_a_replay_leaves_the_table_that_the_machine_has_learned(tmp_path, short_cycle, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short_cycle["controller"].update({"learning.learn": True, "learning.file": str(tmp_path / "learned.csv")})
    recorded_run(tmp_path / "run", short_cycle)
    before = content()
    assert "learned.csv" in before
    found = replay_through_graph(tmp_path / "run", tmp_path / "replay")
    assert found.commands > 0 and {name: data for name, data in content().items() if name in before} == before
    assert {Path(name).parts[0] for name in content().keys() - before.keys()} == {"replay"}
    # Not where a driver listens.
    assert read_streams(found.bag, {"/replay/command": COMMAND.layout})
    assert not read_streams(found.bag, {"/command": COMMAND.layout})
