"""A recorded bag in the real graph, without a driver."""

from pathlib import Path

import pytest

from straightcomp_ros.bags.simulated_run import SimulatedRun
from straightcomp_ros.launcher import LaunchError
from straightcomp_ros.replay.graph import replay_through_graph
from straightcomp_ros.simulation import Simulation


@pytest.mark.live
def test_the_nodes_answer_played_samples_as_they_were_recorded_to_the_bit(tmp_path, short_cycle):
    simulation = Simulation(short_cycle)
    with SimulatedRun(tmp_path / "run", short_cycle, simulation.delay) as run:
        simulation.run(observe=run.add)
    found = replay_through_graph(tmp_path / "run", tmp_path / "replay")
    assert found.different == 0
    # A busy machine may lose some on the way; whatever comes back must be the same.
    assert found.equal > 0.5 * found.samples


def test_a_bag_without_samples_stops_the_player_with_the_reason(tmp_path, short_cycle, single):
    player = single.start("player", {"bag": str(Path(tmp_path) / "nowhere")})
    assert player.wait(120) == 2
    assert "does not exist" in single.last_words("player")
    with pytest.raises(LaunchError, match="player"):
        single.check(["player"])
