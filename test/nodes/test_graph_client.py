"""What nodes report of themselves, what their clients see of it, and that one client commissions at a time."""

import signal
import subprocess
import sys
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from itertools import chain, repeat
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from places import REPOSITORY
from rcl_interfaces.msg import ListParametersResult, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from rclpy.time import Time
from std_srvs.srv import SetBool
from waiting import comes_true

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.contract import (
    COMMISSIONING_CLIENT,
    DIAGNOSTICS,
    DRIVER_STATE,
    HEARTBEAT,
    SAFETY_STATE,
    STAGE_STATE,
)
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.model.paced_motion import StageState
from straightcomp_ros.nodes import view_node
from straightcomp_ros.runtime import graph_client
from straightcomp_ros.runtime.graph_client import GraphClient, Heartbeats, RemoteParameters
from straightcomp_ros.runtime.loops import now_ns
from straightcomp_ros.runtime.node_diagnostics import TICKS, Diagnostics
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState, commissioning_sign, safety_status
from straightcomp_ros.runtime.stage_state import stage_status
from straightcomp_ros.runtime.streams import StreamPublisher
from straightcomp_ros.safety.faults import LONGEST_REASON, Fault
from straightcomp_ros.safety.state_machine import Latched
from straightcomp_ros.timing.node_timing import SAMPLES
from straightcomp_ros.timing.realtime import RealtimeParameters
from straightcomp_ros.tuning.commissioning import CommissioningError
from straightcomp_ros.tuning.graph.waiting_client import WaitingClient

STATES = {"driver": "active", "controller": "active"}


class Driver:
    """Played by the test: sends samples that say the contrary of its safety state."""

    def __init__(self):
        self.node = Node("driver")
        self._state = StreamPublisher(self.node, DRIVER_STATE, at_once=True)
        self._safety = self.node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
        self._stage = self.node.create_publisher(DiagnosticStatus, STAGE_STATE, LATCHED)
        self._diagnostics = self.node.create_publisher(DiagnosticArray, DIAGNOSTICS, 10)
        # Latched: the watch comes later.
        self.say(State.ON)

    def say(self, condition, fault=None):
        self.condition = condition
        self._safety.publish(safety_status(condition, fault, "driver"))

    def move(self, number):
        self._stage.publish(stage_status(StageState("moving", number=number), "driver"))

    def sample(self):
        self._state(time.time_ns(), 0.0, 0.0, 0.0, float(self.condition is not State.ON))

    def report(self, name, error, **values):
        level = DiagnosticStatus.ERROR if error else DiagnosticStatus.OK
        values = [KeyValue(key=key, value=value) for key, value in values.items()]
        status = DiagnosticStatus(level=level, name=name, message=error, values=values)
        self._diagnostics.publish(DiagnosticArray(status=[status]))


class Client(GraphClient):
    states = STATES
    """In place of heartbeats."""


@pytest.fixture
def driver(participant):
    driver = Driver()
    yield driver
    driver.node.destroy_node()


@pytest.fixture
def until(participant, driver):
    """A function that gives the observation as soon as it is as wanted."""
    client = Client(participant.node, list(STATES))

    def until(wanted, states=STATES):
        client.states = states

        def came():
            driver.sample()
            client.fetch()
            return wanted(client.observation())

        participant.until(came)
        return client.observation()

    yield until
    client.streams.close()


def test_the_amplifier_is_what_the_safety_state_says_and_unknown_without_samples(driver, until):
    until(lambda seen: seen.fresh and seen.amplifier_on)
    driver.say(State.OFF)
    until(lambda seen: seen.fresh and not seen.amplifier_on)
    driver.say(State.ON)
    until(lambda seen: seen.fresh and seen.amplifier_on)
    driver.sample = lambda: None
    assert not until(lambda seen: not seen.fresh).amplifier_on


def test_a_fault_of_the_driver_is_seen_from_its_safety_state_alone_and_others_from_their_diagnostics(driver, until):
    driver.say(State.FAULT, Latched(Fault.TRIPPED, "the door is open", 1))
    observation = until(lambda seen: seen.faults)
    assert observation.faults == {"driver": "tripped: the door is open"} and not observation.amplifier_on
    assert observation.fault_code == Fault.TRIPPED.code
    driver.report("driver", "an older one")
    driver.report("controller", "no samples")
    until(lambda seen: seen.faults == {"driver": "tripped: the door is open", "controller": "no samples"})
    for state in ("absent", "silent"):
        gone = until(lambda seen: True, {**STATES, "driver": state})
        assert "driver" not in gone.faults and gone.fault_code == 0
    driver.report("controller", "")
    driver.say(State.OFF)
    assert until(lambda seen: not seen.faults).fault_code == 0


def test_a_driver_that_does_not_report_says_nothing_of_the_stage_and_has_begun_no_other_motion(driver, until):
    driver.move(7)
    until(lambda seen: seen.stage == StageState("moving", number=7))
    for state in ("absent", "starting", "silent"):
        gone = until(lambda seen: True, {**STATES, "driver": state})
        assert gone.stage == StageState("", number=7) and not gone.stands
    assert until(lambda seen: True).stage.condition == "moving"


def test_statuses_of_other_programs_and_namespaces_are_neither_faults_of_this_graph_nor_kept(driver, until):
    driver.say(State.OFF)
    for name in ("line_4/controller", "line_4/camera: frames", "camera_1", "camera_2"):
        driver.report(name, "no samples")
    driver.report("logger", "disk\x1b[2J\nfull" * 1000, samples="\r9")
    faults = until(lambda seen: seen.faults).faults
    assert set(faults) == {"logger"} and len(faults["logger"]) <= LONGEST_REASON and faults["logger"].isprintable()


def enabling(node, success=True, before=lambda: None):
    """What is asked for of the service `driver/enable`, which a node offers; what is done before it is answered."""
    asked = []

    def enable(request, response):
        asked.append(request.data)
        before()
        response.success, response.message = success, "no"
        return response

    node.create_service(SetBool, "driver/enable", enable)
    return asked


def test_the_example_of_a_client_leaves_the_amplifier_off_whatever_ends_it(participant, driver):
    impatient = []
    asked = enabling(participant.node, before=lambda: impatient and impatient.pop().send_signal(signal.SIGINT))
    example = str(REPOSITORY / "examples" / "stroke_client.py")

    def ended(words, end=lambda client: None, waits=True):
        asked.clear()
        with subprocess.Popen([sys.executable, example, *words], stderr=subprocess.PIPE, text=True) as client:
            impatient[:] = [] if waits else [client]
            participant.until(lambda: asked or client.poll() is not None)
            participant.spin(0.5)
            end(client)
            participant.until(lambda: client.poll() is not None)
            return client.returncode, client.stderr.read().strip().splitlines()[-1], list(asked)

    driver.say(State.ON)
    code, said, seen = ended(["0"])
    assert code == 1 and seen == [] and "1 to 1000" in said
    assert ended(["3"], lambda client: client.send_signal(signal.SIGINT)) == (1, "interrupted", [True, False])
    assert ended(["3"], waits=False) == (1, "interrupted", [True, False])
    fault = Latched(Fault.Y_FROZEN, "y stands", 0)
    code, said, seen = ended(["3"], lambda client: driver.say(State.FAULT, fault))
    assert (code, seen) == (1, [True, False]) and said.startswith("amplifier off: y_frozen")


@pytest.mark.parametrize("end", ["answers", "refuses", "reports it off", "reported it off before", "leaves"])
def test_a_client_that_leaves_knows_what_became_of_the_amplifier(participant, driver, end):
    # The driver's own node is not spun: it does not answer.
    asked = enabling(participant.node if end in ("answers", "refuses") else driver.node, end == "answers")
    client = GraphClient(participant.node, ["driver"], batches=())
    participant.until(lambda: client.safety.amplifier_on and client._clients["driver/enable"].ready)
    if end == "reported it off before":
        driver.say(State.OFF)
        participant.until(lambda: not client.safety.amplifier_on)
    left = client.leave()
    if end == "reports it off":
        participant.spin(0.2)
        assert not left.done()
        driver.say(State.OFF)
    if end == "leaves":
        driver.node.destroy_node()
    participant.until(left.done)
    assert left.result() == {"refuses": "no", "leaves": "the driver has left the graph"}.get(end, "")
    assert asked == ([False] if end in ("answers", "refuses") else [])
    client.streams.close()


def test_a_node_that_is_still_in_a_transition_is_not_asked_for_it_again(participant):
    name, calls = participant.node.get_name(), Mock()
    client = GraphClient(participant.node, [name], batches=())
    client._change_state[name] = calls
    beats = participant.node.create_publisher(DiagnosticStatus, HEARTBEAT, 10)
    participant.until(lambda: beats.get_subscription_count() and client._present)
    for asked in (1, 2):
        beats.publish(DiagnosticStatus(name=name, message="unconfigured"))
        participant.until(lambda: client._heartbeats.ages[name] < 0.1)
        client.activate()
        participant.spin(0.6)  # it configures
        client.activate()
        assert calls.call.call_count == asked
    client.streams.close()


@pytest.mark.parametrize(
    "text", ["\x1b[2J", "\n[FATAL] [driver]: on", "\r", "\x9b2J", "\u202e", "\u2028", "\t", "\x00"]
)
def test_a_reason_of_another_node_is_one_line_that_steers_no_terminal(text):
    shown = SafetyState.of(DiagnosticStatus(name=f"tripped{text}", message=f"a{text}b")).fault
    assert shown.isprintable() and shown.startswith("tripped\\") and shown.endswith("b")


def test_a_node_is_silent_before_its_first_heartbeat_and_a_second_after_its_last_which_no_pause_of_the_observer_is(
    monkeypatch,
):
    now, node = [0.0], Mock()
    monkeypatch.setattr(graph_client, "time", SimpleNamespace(monotonic=lambda: now[0]))
    heartbeats = Heartbeats(node, ["logger"], timeout=1.0)
    receive, tick = node.create_subscription.call_args.args[2], node.create_timer.call_args.args[1]
    assert heartbeats.silent() == ["logger"]
    receive(DiagnosticStatus(name="logger", message="active"))
    silent = []
    for _ in range(12):
        now[0] += 60.0
        tick()
        silent.append(bool(heartbeats.silent()))
    assert silent.index(True) in (9, 10) and heartbeats.states == {"logger": "active"}


@pytest.mark.parametrize("simulated", [False, True])
def test_a_report_has_the_level_of_its_values_hardware_namespace_and_the_time_of_samples_or_of_a_simulation_that_began(
    participant, simulated
):
    of_simulation = [Parameter("use_sim_time", value=simulated)]
    found, node = [], Node("reporter", namespace="/line_3", parameter_overrides=of_simulation)
    participant.node.create_subscription(DiagnosticArray, DIAGNOSTICS, found.append, 100)
    diagnostics = Diagnostics(node, lambda: {SAMPLES: 0, "error": "coil burnt"}, hardware_id="bench 7")
    participant.until(lambda: node.count_subscribers(DIAGNOSTICS) and participant.node.count_publishers(DIAGNOSTICS))

    def reported():
        for _ in range(TICKS):
            diagnostics.tick()
        participant.until(lambda: found)
        return found.pop()

    before_ns, report = now_ns(), reported()
    (status,) = report.status
    assert (status.level, status.message) == (DiagnosticStatus.ERROR, "coil burnt")
    assert (status.name, status.hardware_id) == ("line_3/reporter", "bench 7")
    assert before_ns <= Time.from_msg(report.header.stamp).nanoseconds <= now_ns()
    if simulated:
        node.get_clock().set_ros_time_override(Time(seconds=7, clock_type=node.get_clock().clock_type))
        assert reported().header.stamp.sec == 7
    node.destroy_node()


RATE = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=2000.0)


def done(result):
    future = Future()
    future.set_result(result)
    return future


@pytest.mark.parametrize("name", ["driver", "/line/driver"])
def test_a_node_whose_response_was_lost_is_asked_again_until_it_has_answered(monkeypatch, name):
    names = ListParameters.Response(result=ListParametersResult(names=["stage.rate"]))
    client = Mock(**{"get_parameters.return_value": done(GetParameters.Response(values=[RATE]))})
    # It is there after the first look, and its first request is never answered.
    client.services_are_ready.side_effect = chain([False], repeat(True))
    client.list_parameters.side_effect = chain([Future()], repeat(done(names)))
    monkeypatch.setattr(graph_client, "AsyncParameterClient", Mock(return_value=client))
    processes, node = [], Mock()
    node.get_namespace.return_value, node.get_publishers_info_by_topic.return_value = "/line", processes
    remote = RemoteParameters(node, [name])
    ((_, look), _) = node.create_timer.call_args

    def asked():
        for _ in range(30):
            look()
        return client.list_parameters.call_count

    assert asked() == 2 and remote.complete and remote.values == {name: {"stage.rate": 2000.0}}
    # Of a node that is started anew, another process is seen; that of another machine is none of ours.
    processes.append(SimpleNamespace(node_name="driver", node_namespace="/line_2", endpoint_gid=[1]))
    assert asked() == 2
    for number in (2, 3):
        processes.append(SimpleNamespace(node_name="driver", node_namespace="/line", endpoint_gid=[number]))
        assert asked() == asked() == 1 + number
    remote.ask_again()
    assert not remote.complete and asked() == 5 and remote.complete


def test_parameters_of_another_node_follow_its_changes(participant):
    seen, changing = Node("seen", namespace="/line"), Node("driver", namespace="/line")
    other = Node("driver", namespace="/line_2")
    for node in (changing, other):
        node.declare_parameter("stage.rate", 2000.0)
    remotes = {name: RemoteParameters(seen, [name]) for name in ("driver", "/line/driver")}
    executor = SingleThreadedExecutor()
    for node in (seen, changing, other):
        executor.add_node(node)

    def until(condition):
        return comes_true(lambda: executor.spin_once(0.05) or condition())

    def rates():
        return [remote.values[name]["stage.rate"] for name, remote in remotes.items()]

    assert until(lambda: all(remote.complete for remote in remotes.values())) and rates() == [2000.0, 2000.0]
    other.set_parameters([Parameter("stage.rate", value=10.0)])
    changing.set_parameters([Parameter("stage.rate", value=1000.0)])
    assert until(lambda: 2000.0 not in rates())
    assert rates() == [1000.0, 1000.0]
    executor.shutdown()
    for node in (seen, changing, other):
        node.destroy_node()


def test_a_client_is_refused_with_what_another_one_does_and_may_begin_when_that_has_just_ended():
    # With a context of its own, as in another process.
    context = rclpy.Context()
    rclpy.init(context=context)
    other = Node(COMMISSIONING_CLIENT, context=context)
    commissioning_sign(other)("acceptance")
    with WaitingClient(()) as client:
        # Without nodes there is nothing whose discovery would show that all others are discovered too.
        assert comes_true(lambda: client.commissioning.doing == "acceptance")
        with pytest.raises(CommissioningError, match="machine: acceptance"):
            client.claim()
    with WaitingClient(()) as client:
        assert comes_true(lambda: client.commissioning.doing)
        other.destroy_node()
        rclpy.shutdown(context=context)
        client.claim()("connection")
    # Nor is a client in its own way.
    with WaitingClient(()) as client:
        client.claim()


def test_a_live_view_that_switched_on_switches_off_when_it_is_closed_though_no_samples_came_meanwhile(monkeypatch):
    graph = Mock(safety=SafetyState(), **{"reports.return_value": {}, "fetch.return_value": defaultdict(list)})
    graph.request.side_effect = lambda service, on, then: then("")
    for name, stand_in in (("GraphClient", graph), ("RemoteParameters", Mock(values={})), ("ViewServer", Mock())):
        monkeypatch.setattr(view_node, name, Mock(return_value=stand_in))
    view = view_node.ViewNode(Mock(), 0, Mock(), RealtimeParameters(), "", None)

    def shown(condition, fresh=True):
        graph.safety = SafetyState(condition, "y_frozen" if condition is State.FAULT else "")
        graph.observation.return_value = Observation(fresh=fresh, amplifier_on=fresh and condition is State.ON)
        view._fetch()
        return view.leave() is not None

    def pressed(button):
        with ThreadPoolExecutor() as pool:
            answer = pool.submit(button)
            while not answer.done():
                view._fetch()
        return answer.result()

    assert not shown(State.ON)
    enable = view_node.ViewServer.call_args[0][2]["enable"]
    assert not shown(State.OFF) and pressed(enable) == "amplifier on"
    assert [shown(State.OFF), shown(State.ON), shown(State.ON, fresh=False), shown(State.ON)] == [True] * 4
    assert not shown(State.OFF) and not shown(State.ON)
    # One that a fault switches off at once, and another client on again, is that client's.
    assert not shown(State.OFF) and pressed(enable) == "amplifier on"
    assert not shown(State.FAULT) and not shown(State.ON)
