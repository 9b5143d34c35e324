"""A recorded bag in the real graph, without a driver."""

import time
from pathlib import Path

import pytest
import rclpy
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.cell.launcher import LaunchError
from straightcomp_ros.contract import CLOCK, ENCODER, POSITION_EVERY
from straightcomp_ros.offline.graph_replay import replay_through_graph
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.runtime.streams import stream_qos, subscribe


@pytest.mark.live
def test_the_nodes_answer_played_samples_as_they_were_recorded_to_the_bit(tmp_path, short_cycle):
    simulation = Simulation(short_cycle)
    with SimulatedRun(tmp_path / "run", short_cycle, simulation.delay) as run:
        simulation.run(observe=run.add)
    found = replay_through_graph(tmp_path / "run", tmp_path / "replay")
    assert found.different == 0
    # A busy machine may lose some on the way; whatever comes back must be the same.
    assert found.equal > 0.5 * found.samples


def test_the_time_of_the_samples_is_on_the_clock_where_it_is_asked_for(tmp_path, short_cycle, single):
    simulation = Simulation(short_cycle)
    with SimulatedRun(tmp_path / "run", short_cycle, simulation.delay) as run:
        simulation.run(observe=run.add)
    times = []
    rclpy.init()
    node = Node("listener")
    try:
        node.create_subscription(Clock, CLOCK, lambda m: times.append(Time.from_msg(m.clock).nanoseconds), stream_qos())
        subscribe(node, ENCODER, lambda stamp_ns, _: None)
        single.start("player", {"bag": str(tmp_path / "run"), "subscribers": 1, "clock": True, "speed": 4.0})
        end = time.monotonic() + 120.0
        while len(times) < 20 and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    # The clock may be connected after the first samples, and a busy machine may lose some of its messages.
    ticks = read_streams(tmp_path / "run", {ENCODER.topic: ENCODER.layout})[ENCODER.topic].stamp[::POSITION_EVERY]
    assert len(times) >= 20 and set(times) <= set(ticks.tolist())
    assert times == sorted(set(times))


def test_a_bag_without_samples_stops_the_player_with_the_reason(tmp_path, short_cycle, single):
    player = single.start("player", {"bag": str(Path(tmp_path) / "nowhere")})
    assert player.wait(120) == 2
    assert "does not exist" in single.last_words("player")
    with pytest.raises(LaunchError, match="player"):
        single.check(["player"])
