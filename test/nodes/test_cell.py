"""The reference client in the running graph: what it does about a fault in mid-cycle."""

import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from waiting import wait_for_line

from straightcomp_ros.contract import TRIP
from straightcomp_ros.nodes import cell_node
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
