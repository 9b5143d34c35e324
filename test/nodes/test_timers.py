"""Timers of a node under the EventsExecutor, and by themselves."""

import itertools
import time

import pytest
import rclpy
from rclpy.experimental import EventsExecutor

from straightcomp_ros.runtime.guarded_node import TICK_S, GuardedNode, SteadyTimers

_STALL_S, _PERIOD_S, _TURN_S = 1.0, 0.1, 0.006
_THREE_PERIODS = 3 * _PERIOD_S / _TURN_S
"""Turns of a loop in this time, at most."""


class Clock:
    """A clock that stands still until it is set."""

    def __init__(self):
        self.now_ns = 10**9

    def __call__(self):
        return self.now_ns

    def pass_s(self, seconds):
        self.now_ns += round(seconds * 1e9)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def timers(clock):
    return SteadyTimers(clock)


def _beating(node, turn):
    """Six timers that note the loop's turn of each of their beats."""
    beats = [[] for _ in range(6)]
    for noted in beats:
        node.create_timer(_PERIOD_S, lambda noted=noted: noted.append(turn[0]))
    return beats


def _longest_silence(node, add_more=lambda: None):
    """Turns without a beat of one of six timers, under an executor that is spun as a loop spins it, with a stall before
    its first turn and one amid."""
    turn = [0]
    beats = _beating(node, turn)
    executor = EventsExecutor()
    time.sleep(_STALL_S)
    executor.add_node(node)
    for turn[0] in range(260):
        if turn[0] == 130:
            add_more()
            time.sleep(_STALL_S)
        executor.spin_once(timeout_sec=0)
        time.sleep(_TURN_S)
    return max(later - sooner for noted in beats for sooner, later in itertools.pairwise([0, *noted, 260]))


@pytest.mark.parametrize("add_more", [lambda node: None, lambda node: _beating(node, [0])], ids=["alone", "added"])
def test_timers_that_are_due_when_their_node_or_others_are_added_do_not_fall_silent(monkeypatch, add_more):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    node = GuardedNode("beating")
    assert _longest_silence(node, lambda: add_more(node)) < _THREE_PERIODS
    node.destroy_node()
    rclpy.try_shutdown()


def test_a_timer_is_called_once_in_each_period_and_once_after_a_stall(timers, clock):
    calls = []
    timers.add(0.1, lambda: calls.append(clock.now_ns))
    for _ in range(100):
        clock.pass_s(0.01)
        timers.call_all()
    assert len(calls) == 10
    clock.pass_s(1.05)
    timers.call_all()
    timers.call_all()
    assert len(calls) == 11
    clock.pass_s(0.1)
    timers.call_all()
    assert len(calls) == 12


def test_one_turn_calls_the_timer_that_has_been_due_for_longest(timers, clock):
    calls = []
    timers.add(0.2, lambda: calls.append("slow"))
    timers.add(0.1, lambda: calls.append("quick"))
    clock.pass_s(0.3)
    assert timers.call_one()
    assert calls == ["quick"]
    assert timers.call_one()
    assert calls == ["quick", "slow"]
    assert not timers.call_one()


def test_a_cancelled_timer_is_never_called_even_if_another_cancels_it_in_the_same_turn(timers, clock):
    calls = []
    timers.add(0.1, lambda: calls.append("kept"))
    mark = timers.mark()
    timers.add(0.11, lambda: timers.cancel_after(mark))
    timers.add(0.1, lambda: calls.append("cancelled")).cancel()
    timers.add(0.12, lambda: calls.append("late"))
    clock.pass_s(0.5)
    timers.call_all()
    assert calls == ["kept"]


def test_a_timer_is_due_at_a_tick_whenever_it_was_added(clock):
    timers = SteadyTimers(clock)
    clock.pass_s(0.7 * TICK_S)
    timer = timers.add(TICK_S, lambda: None)
    assert timer.due_ns == 10**9 + 2 * TICK_S * 1e9
