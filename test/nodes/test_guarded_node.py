"""A node whose callbacks' errors end it not, and whose timers beat after every stall."""

import itertools
import time
from types import SimpleNamespace

import pytest
import rclpy
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from straightcomp_ros.bags import BagError
from straightcomp_ros.runtime import guarded_node
from straightcomp_ros.runtime.guarded_node import TICK_S, GuardedNode, Refused, SteadyTimers, ThrottledWarning, refusal


def test_a_flood_of_wrong_messages_is_logged_every_five_seconds_with_the_number_of_the_others(monkeypatch):
    now, warnings = [100.0], []
    node = SimpleNamespace(get_logger=lambda: SimpleNamespace(warning=warnings.append))
    monkeypatch.setattr(guarded_node, "time", SimpleNamespace(monotonic=lambda: now[0]))
    warning = ThrottledWarning(node, "a message is dropped")
    for _ in range(5000):
        warning.log(ValueError("x" * 100_000))
    now[0] += 5.0
    warning.log(KeyError())
    assert len(warnings) == 2 and max(map(len, warnings)) < 400
    assert "KeyError (and 4999 more" in warnings[1]


def failing(error):
    def callback(*_):
        raise error

    return callback


def test_an_error_of_a_callback_drops_the_message_or_refuses_the_request_and_one_of_the_machine_passes(monkeypatch):
    reached, warnings = {}, []
    for kind in ("subscription", "service"):
        monkeypatch.setattr(Node, f"create_{kind}", lambda self, kind, name, callback: reached.update({name: callback}))
    monkeypatch.setattr(GuardedNode, "get_logger", lambda self: SimpleNamespace(warning=warnings.append))
    monkeypatch.setattr(Node, "__init__", lambda self: None)
    node = GuardedNode()
    node.create_subscription(object, "trip", failing(ValueError("n/a")))
    node.create_service(SetBool, "enable", failing(KeyError("n/a")))
    node.offer(Trigger, "stop", failing(Refused("nothing is going on")))
    node.offer(SetBool, "center", lambda middle: f"to {middle}")
    node.offer(Trigger, "start", failing(BagError("disk full")))
    node.offer(Trigger, "home", failing(BagError("not now")), BagError)

    def answer(name, kind):
        response = reached[name](kind.Request(), kind.Response(success=True))
        return response.success, response.message

    reached["trip"](None)
    assert answer("enable", SetBool) == (False, "'n/a'") and len(warnings) == 2
    # A refusal is the node's answer, and no error of its callback.
    assert answer("stop", Trigger) == (False, "nothing is going on")
    assert answer("home", Trigger) == (False, "not now")
    assert answer("center", SetBool) == (True, "to False")
    with pytest.raises(BagError):
        answer("start", Trigger)
    assert len(warnings) == 2
    # A service is made once, and stays: whoever asks between two of its kind would never have an answer.
    first = reached.copy()
    node.refuse_all("not now")
    assert answer("center", SetBool) == (False, "not now")
    node.offer(SetBool, "center", lambda middle: f"back to {middle}")
    assert answer("center", SetBool) == (True, "back to False") and reached == first
    result = refusal(SetParametersAtomically.Response(), "255 is no type").result
    assert not result.successful and result.reason == "255 is no type"


STALL_S, PERIOD_S, TURN_S, TURNS = 1.0, 0.1, 0.006, 260


def beating(node, turn):
    """Six timers that note the loop's turn of each of their beats."""
    beats = [[] for _ in range(6)]
    for noted in beats:
        node.create_timer(PERIOD_S, lambda noted=noted: noted.append(turn[0]))
    return beats


@pytest.mark.parametrize("others", [False, True], ids=["alone", "added"])
def test_timers_that_are_due_when_their_node_or_others_are_added_do_not_fall_silent(monkeypatch, others):
    """Under an executor that is spun as a loop spins it, with a stall before its first turn and one amid."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    node, executor, turn = GuardedNode("beating"), EventsExecutor(), [0]
    beats = beating(node, turn)
    time.sleep(STALL_S)
    executor.add_node(node)
    for turn[0] in range(TURNS):
        if turn[0] == TURNS // 2:
            if others:
                beating(node, [0])
            time.sleep(STALL_S)
        executor.spin_once(timeout_sec=0)
        time.sleep(TURN_S)
    silences = [later - sooner for noted in beats for sooner, later in itertools.pairwise([0, *noted, TURNS])]
    assert max(silences) < 3 * PERIOD_S / TURN_S
    node.destroy_node()
    rclpy.try_shutdown()


class Timers(SteadyTimers):
    """On a clock that stands still until it is set; ``calls`` are the names of timers that were called."""

    def __init__(self):
        self.now_ns, self.calls = 10**9, []
        super().__init__(lambda: self.now_ns)

    def named(self, period_s, name):
        return self.add(period_s, lambda: self.calls.append(name))

    def after(self, seconds):
        """Calls what is due then."""
        self.now_ns += round(seconds * 1e9)
        self.call_all()
        return self.calls


def test_a_timer_is_called_at_a_tick_once_in_each_period_and_once_after_a_stall_the_longest_due_first():
    timers = Timers()
    timers.after(0.7 * TICK_S)
    assert timers.named(TICK_S, "early").due_ns == 10**9 + 2 * TICK_S * 1e9
    timers = Timers()
    timers.named(0.1, "one")
    for _ in range(100):
        timers.after(0.01)
    assert [len(timers.after(seconds)) for seconds in (0.0, 1.05, 0.0, 0.1)] == [10, 11, 11, 12]
    timers = Timers()
    timers.named(0.2, "slow")
    timers.named(0.1, "quick")
    timers.now_ns += 300_000_000
    assert [timers.call_one() for _ in range(3)] == [True, True, False]
    assert timers.calls == ["quick", "slow"]


def test_a_cancelled_timer_is_never_called_even_if_another_cancels_it_in_the_same_turn():
    timers = Timers()
    timers.named(0.1, "kept")
    timers.add(0.11, lambda: late.cancel())
    timers.named(0.1, "cancelled").cancel()
    late = timers.named(0.12, "late")
    assert timers.after(0.5) == ["kept"]
