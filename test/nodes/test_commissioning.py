"""A running graph is commissioned by services and from the command line, and no cycle runs meanwhile."""

import json
import re
import signal
import subprocess
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import SetBool, Trigger
from waiting import wait_for_line

from straightcomp_ros.cell.launcher import RECORDED, verb_command
from straightcomp_ros.contract import COMMISSIONING_CLIENT, COMMISSIONING_STATE, SAFETY_STATE
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.safety.faults import Fault

pytestmark = pytest.mark.keeps_time


class Asker:
    """Calls services and reads what the node `commissioning` tells."""

    def __init__(self) -> None:
        rclpy.init()
        self.node, self.told = Node("asker"), []
        self.node.create_subscription(DiagnosticStatus, COMMISSIONING_STATE, self.told.append, LATCHED)

    def until(self, done, within=90.0):
        end = time.monotonic() + within
        while not done():
            assert time.monotonic() < end, [(one.name, one.message) for one in self.told]
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def ask(self, kind, name, request=None):
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        self.node.destroy_client(client)
        return future.result()

    def state(self, node):
        return self.ask(GetState, f"{node}/get_state").current_state.label

    def parameter(self, node, name):
        answer = self.ask(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=[name]))
        return parameter_value_to_python(answer.values[0])


@pytest.fixture
def asker():
    one = Asker()
    yield one
    one.node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def loop(graph, short_cycle, tmp_path):
    """The nodes of the loop and a logger, unconfigured."""
    short_cycle["stage"]["platform.stop"] = 8e-4
    for node in RECORDED:
        # A cell may activate the logger before it hears of commissioning.
        output = {"output": str(tmp_path / "bag")} if node == "logger" else {}
        graph.start(node, {**described(short_cycle, node), **output, "autostart": False})
    return graph


def described(values, node):
    stage = {} if node == "logger" else {f"stage.{name}": value for name, value in values["stage"].items()}
    return {**stage, **values[node]}


def test_the_node_runs_steps_by_services_and_the_cell_is_refused_meanwhile(loop, short_cycle, asker, tmp_path):
    loop.start("commissioning", {"output": str(tmp_path / "found")})
    asker.until(lambda: asker.told)
    # A step that rests on others is refused with their names.
    assert asker.ask(Trigger, "commissioning/signs_and_scales").success
    asker.until(lambda: asker.told[-1].name == "signs_and_scales" and asker.told[-1].level == DiagnosticStatus.ERROR)
    assert "rests on 'connection'" in asker.told[-1].message
    assert asker.ask(Trigger, "commissioning/connection").success
    assert "connection is going on" in asker.ask(Trigger, "commissioning/run").message
    # The process takes its time to start.
    signs = []
    asker.node.create_subscription(DiagnosticStatus, COMMISSIONING_CLIENT, signs.append, LATCHED)
    asker.until(lambda: signs and signs[-1].message == "connection")
    cell = loop.start("cell", {**described(short_cycle, "cell"), "start_timeout": 20.0})
    assert cell.wait(timeout=60) == 1
    assert "cycle failed: the machine is being commissioned" in loop.log("cell").read_text()
    asker.until(lambda: asker.told[-1].message != "is going on")
    assert asker.told[-1].level == DiagnosticStatus.OK and "none lost" in asker.told[-1].message
    record = json.loads((tmp_path / "found" / "commission.json").read_text())
    assert record["steps"]["connection"]["passed"] and record["steps"]["connection"]["figures"]["latency_us"]
    assert asker.ask(Trigger, "commissioning/signs_and_scales").success
    asker.until(lambda: asker.told[-1].name == "signs_and_scales" and asker.told[-1].message != "is going on")
    assert asker.told[-1].level == DiagnosticStatus.OK, asker.told[-1].message
    assert float(re.search(r"readback (\S+) times the command", asker.told[-1].message)[1]) == pytest.approx(
        1.0, abs=0.02
    )
    assert not asker.ask(Trigger, "commissioning/stop").success


def left_as_found(asker, folder):
    for node in ("driver", "feedforward", "controller"):
        assert asker.state(node) == "inactive"
    assert asker.parameter("controller", "error_limit") == 0.1
    # A cell can configure the logger.
    assert asker.state("logger") == "unconfigured"
    assert asker.parameter("logger", "output") == str(folder / "bag")
    # Its client left with the amplifier off.
    assert asker.ask(Trigger, "driver/reset_fault").message == "there was no fault"


def test_the_response_of_a_running_loop_is_measured_and_the_nodes_are_left_as_they_were(loop, asker, tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    words = ("--graph", "running", "--json", "--draws", "4", "--highest", "200", "-o", "loop.png")
    told = subprocess.run(
        verb_command("frequency-response", *words), capture_output=True, text=True, timeout=120, cwd=here
    )
    assert told.returncode == 0, told.stderr
    found = json.loads(told.stdout)
    assert found["law"] == "smc_observer" and 15.0 < found["margins"]["phase_deg"] < 60.0
    left_as_found(asker, tmp_path)
    # Though the logger was started elsewhere.
    assert (here / "loop.png").exists() and (here / "loop_graph" / "bags" / "frequency_response").is_dir()


def test_a_client_that_is_told_to_end_leaves_the_nodes_as_they_were_and_another_is_refused_meanwhile(
    loop, asker, tmp_path
):
    states = []
    asker.node.create_subscription(
        DiagnosticStatus, SAFETY_STATE, lambda message: states.append(SafetyState.of(message)), LATCHED
    )
    words = verb_command("frequency-response", "--graph", "running", "--draws", "40")
    client = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        asker.until(lambda: states and states[-1].amplifier_on)
        other = subprocess.run(words, capture_output=True, text=True, timeout=120)
        assert other.returncode == 1
        # By its sign, or by the amplifier if that is heard first.
        assert "somebody else" in " ".join(other.stderr.split())
        assert states[-1].amplifier_on
        client.send_signal(signal.SIGTERM)
        assert client.wait(timeout=60) == 143
        assert "terminated" in client.stderr.read()
    finally:
        client.kill()
        client.wait()
    left_as_found(asker, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_client_that_is_killed_or_suspended_leaves_the_amplifier_off(loop, asker, number, tmp_path):
    states = []
    asker.node.create_subscription(
        DiagnosticStatus, SAFETY_STATE, lambda message: states.append(SafetyState.of(message)), LATCHED
    )
    client = subprocess.Popen(verb_command("frequency-response", "--graph", "running", "--draws", "4"))
    try:
        asker.until(lambda: states and states[-1].amplifier_on)
        client.send_signal(number)
        asker.until(lambda: not states[-1].amplifier_on)
    finally:
        client.kill()
        client.wait()
    assert states[-1].code == Fault.CLIENT_GONE.code, states
    assert asker.parameter("controller", "error_limit") != 0.1
    # The next one does not take what was left for the machine's own.
    told = subprocess.run(
        verb_command("frequency-response", "--graph", "running", "--draws", "4"),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert told.returncode == 0, told.stderr
    left_as_found(asker, tmp_path)


def test_while_somebody_uses_the_machine_it_is_not_commissioned(graph, short_cycle, asker, tmp_path):
    for node in RECORDED:
        graph.start(
            node, {**described(short_cycle, node), **({"output": str(tmp_path / "b")} if node == "logger" else {})}
        )
    wait_for_line(graph, "controller", "ready")
    asker.until(lambda: asker.ask(SetBool, "driver/enable", SetBool.Request(data=True)).success)
    words = ("commission", "-o", str(tmp_path / "found"), "--graph", "running", "--only", "connection")
    told = subprocess.run(verb_command(*words), capture_output=True, text=True, timeout=120)
    assert told.returncode == 1 and "somebody else uses the machine" in " ".join(told.stderr.split())
    # It stays on.
    assert "amplifier on" in asker.ask(SetBool, "driver/enable", SetBool.Request(data=True)).message
