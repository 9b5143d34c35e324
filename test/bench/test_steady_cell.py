"""The cell for measuring: the motion goes on, whatever the amplifier does."""

from dataclasses import replace

import pytest

from straightcomp_ros.cell.launcher import ros_available
from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cell.packml import Command, State
from straightcomp_ros.model.motion import MotionParameters, cycles

if not ros_available():
    pytest.skip("rclpy is not there", allow_module_level=True)

from straightcomp_ros.bench.steady_cell import SteadySequence

MOTION = MotionParameters(stroke=0.1, settle=0.2, pause=0.1)


class Graph:
    """Notes what it is asked for, and a clock that ticks by hand."""

    refusal = obstacle = ""

    def __init__(self):
        self.now, self.moves, self.asked = 100.0, [], []
        self.seen = Observation(nodes={"driver": "active"}, fresh=True, stamp_ns=1)
        self.sequence = SteadySequence(self, MOTION, 5.0, clock=lambda: self.now, as_one=True)

    def center(self, middle, then):
        then("")

    def switch_on(self):
        self.asked.append("on")

    def reset_faults(self):
        self.asked.append("reset")

    def end_motion(self):
        """Of no concern here: the stage stands when the cell resets."""

    def move(self, waypoints):
        self.moves.append(waypoints)

    def begin(self):
        assert not self.sequence.command(Command.RESET)
        self.until(State.IDLE)
        assert not self.sequence.command(Command.START, 1)
        self.until(State.EXECUTE)

    def until(self, state):
        for _ in range(1000):
            self.now += 0.05
            self.sequence.tick(self.seen)
            if self.sequence.state is state:
                return
        raise AssertionError(self.sequence.message)


@pytest.mark.parametrize("on", [True, False])
def test_the_motion_begins_with_the_amplifier_on_or_when_patience_is_over(on, capsys):
    graph = Graph()
    graph.seen = replace(graph.seen, amplifier_on=on, faults={} if on else {"driver": "tripped"})
    graph.begin()
    began = graph.now
    for _ in range(20):
        graph.until(State.EXECUTE)
    assert [len(points) for points in graph.moves] == [len(cycles(MOTION, 1))]
    assert graph.asked.count("on") == graph.asked.count("reset") and bool(graph.asked) is not on
    assert ("measuring with the amplifier off" in capsys.readouterr().err) is not on
    duration = cycles(MOTION, 1)[-1].time_ns * 1e-9
    assert graph.sequence.progress == pytest.approx((graph.now - began) / duration, abs=0.1)


def test_an_amplifier_that_goes_off_is_switched_on_again_and_the_motion_goes_on():
    graph = Graph()
    graph.seen = replace(graph.seen, amplifier_on=True)
    graph.begin()
    graph.seen = replace(graph.seen, amplifier_on=False, fresh=False, faults={"driver": "tripped"})
    for _ in range(100):
        graph.until(State.EXECUTE)
    assert graph.asked.count("on") >= 9 and len(graph.moves) == 1
