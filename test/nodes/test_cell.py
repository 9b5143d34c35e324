"""The reference client in the running graph: what it does about a fault in mid-cycle."""

import signal
import sys
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from participant import Participant
from rclpy.node import Node
from waiting import wait_for_line

from straightcomp_ros.contract import DIAGNOSTICS, SAFETY_STATE, TRIP
from straightcomp_ros.nodes import cell_node
from straightcomp_ros.runtime.safety_panel import LATCHED, SafetyState
from straightcomp_ros.timing.node_timing import CPU_WAIT, REFUSED, SCHEDULING

pytestmark = pytest.mark.keeps_time


@pytest.fixture
def trip():
    """A function that trips the driver, once it listens."""
    rclpy.init()
    node = Node("panel")
    publisher = node.create_publisher(DiagnosticStatus, TRIP, 10)

    def publish():
        end = time.monotonic() + 60.0
        while publisher.get_subscription_count() == 0:
            assert time.monotonic() < end, "nobody listens"
            time.sleep(0.05)
        publisher.publish(DiagnosticStatus(message="somebody is in there"))

    yield publish
    node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize(
    "recoveries, code, words",
    [(3, 0, "cycle complete: 1 strokes"), (0, 1, "amplifier off in mid-cycle: tripped: somebody is in there")],
)
def test_a_fault_in_mid_cycle_is_recovered_from_as_often_as_that_is_allowed(
    graph, short_cycle, trip, recoveries, code, words
):
    short_cycle["controller"]["sample_timeout"] = 30.0
    for node in ("driver", "feedforward", "controller"):
        graph.start(node, short_cycle[node])
    chosen = {"nodes": "driver feedforward controller", "recoveries": recoveries, "home": True, "start_timeout": 60.0}
    cell = graph.start("cell", {**short_cycle["cell"], **chosen})
    wait_for_line(graph, "cell", "stage moves")
    trip()
    assert cell.wait(timeout=120) == code
    told = graph.log("cell").read_text()
    assert words in told
    assert ("fault 1: tripped: somebody is in there; switching on again" in told) is (recoveries > 0)


LOOP = ("driver", "feedforward", "controller")


@pytest.fixture
def cell_at_work(graph, short_cycle):
    """A function that starts a graph and its cell, and returns the cell with the amplifier on and the stage moving."""

    def started(command=None, **parameters):
        for node in LOOP:
            graph.start(node, short_cycle[node])
        chosen = {"nodes": " ".join(LOOP), "start_timeout": 60.0, "heartbeat_timeout": 1.0, **parameters}
        cell = graph.start("cell", {**short_cycle["cell"], **chosen}, command=command)
        wait_for_line(graph, "cell", "stage moves")
        return cell

    return started


@pytest.fixture
def panel():
    """A participant whose attribute ``safety`` is the driver's newest safety state."""
    with Participant("panel") as panel:
        panel.safety = SafetyState()
        panel.node.create_subscription(
            DiagnosticStatus, SAFETY_STATE, lambda message: setattr(panel, "safety", SafetyState.of(message)), LATCHED
        )
        yield panel


def ended(graph, cell, panel):
    """The cell's exit code and log, after which the driver must report the amplifier off without a fault."""
    panel.until(lambda: cell.poll() is not None)
    panel.until(lambda: not panel.safety.amplifier_on)
    assert not panel.safety.fault
    return cell.returncode, graph.log("cell").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_cell_that_is_stopped_in_mid_cycle_switches_off_and_does_not_end_with_0(graph, cell_at_work, panel, number):
    cell = cell_at_work()
    panel.until(lambda: panel.safety.amplifier_on)
    cell.send_signal(number)
    code, log = ended(graph, cell, panel)
    assert code == 1 and "the amplifier has been switched off" in log


def test_a_cell_with_an_error_of_its_own_in_mid_cycle_switches_off(graph, cell_at_work, panel):
    broken = (
        "from straightcomp_ros.nodes import cell_node as c; c.CellNode._follow_motion = lambda self: [1 / 0]; c.main()"
    )
    code, log = ended(graph, cell_at_work([sys.executable, "-c", broken]), panel)
    assert code == 1 and "ZeroDivisionError" in log and "the amplifier has been switched off" in log


def test_a_cell_whose_driver_is_gone_says_that_it_could_not_switch_off(graph, cell_at_work, panel):
    cell = cell_at_work()
    graph._processes["driver"].kill()
    cell.send_signal(signal.SIGTERM)
    assert cell.wait(timeout=60) == 1 and "could not be switched off" in graph.log("cell").read_text()


def test_no_value_in_diagnostics_ends_a_cycle(graph, cell_at_work, panel):
    publisher = panel.node.create_publisher(DiagnosticArray, DIAGNOSTICS, 100)
    cell = cell_at_work()
    panel.until(lambda: publisher.get_subscription_count() > 0)
    keys = ("samples", "lost_samples", "cpu_wait_max_us", "timer_error_max_us", "excitation")
    for value in ("n/a", "", "nan", "-1", "1e400", "9" * 5000):
        values = [KeyValue(key=key, value=value) for key in keys]
        status = [DiagnosticStatus(name=name, values=values) for name in (*LOOP, "logger", "cell")]
        publisher.publish(DiagnosticArray(status=status))
    assert ended(graph, cell, panel)[0] == 0


@pytest.mark.parametrize(("node", "recoveries"), [*((node, 0) for node in LOOP), ("controller", 3)])
def test_a_cell_names_the_node_that_died_and_not_only_what_followed(graph, cell_at_work, node, recoveries):
    cell = cell_at_work(recoveries=recoveries)
    graph._processes[node].kill()
    assert cell.wait(timeout=60) == 1
    assert f"{node} (silent)" in graph.log("cell").read_text()


def test_a_cycle_that_fails_says_which_node_got_no_cpu(monkeypatch):
    rclpy.init()
    node = Node("cell", automatically_declare_parameters_from_overrides=True)
    monkeypatch.setattr(cell_node, "_REPORTED_S", 0.0)
    try:
        cell = cell_node.CellNode(node)
        reports = {
            "driver": {SCHEDULING: REFUSED, CPU_WAIT: "900", "timer_error_max_us": "1200.0"},
            "controller": {SCHEDULING: REFUSED, CPU_WAIT: "181000", "timer_error_max_us": "180000.0"},
        }
        monkeypatch.setattr(cell._watch, "reports", lambda: reports)

        def cycle():
            yield
            raise cell_node.CycleFailed("amplifier off in mid-cycle: command_timeout")

        with pytest.raises(cell_node.CycleFailed) as failed:
            list(cell._explained(cycle()))
        assert str(failed.value) == (
            "amplifier off in mid-cycle: command_timeout (the controller got no CPU for 180 ms; "
            "real-time priority is not permitted; remedy: straightcomp doctor)"
        )
        reports.clear()
        with pytest.raises(cell_node.CycleFailed, match=r"^amplifier off in mid-cycle: command_timeout$"):
            list(cell._explained(cycle()))
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_a_graph_whose_nodes_were_started_with_different_stages_does_not_move(graph, short_cycle):
    for node in ("driver", "feedforward", "controller"):
        graph.start(node, {**short_cycle[node], **({"stage.platform.mass": 3.5} if node == "controller" else {})})
    chosen = {"nodes": "driver feedforward controller", "start_timeout": 60.0}
    cell = graph.start("cell", {**short_cycle["cell"], **chosen})
    assert cell.wait(timeout=120) == 1
    told = graph.log("cell").read_text()
    assert "descriptions of the stage differ (cell synthetic" in told and "stage moves" not in told
