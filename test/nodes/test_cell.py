"""The reference client in the running graph: what it does about faults, signals and nodes that die in mid-cycle."""

import signal
import sys
from itertools import islice
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from parameters_of_tests import loop_parameters, of_node, short_parameters
from waiting import wait_for_line

from straightcomp_ros.cell.launcher import IN_THE_LOOP, RECORDED
from straightcomp_ros.cell.packml import State
from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.nodes import cell_node
from straightcomp_ros.timing.node_timing import CPU_WAIT, REFUSED, SCHEDULING

pytestmark = [pytest.mark.live, pytest.mark.keeps_time]

CHOSEN = {"nodes": " ".join(IN_THE_LOOP), "start_timeout": 90.0, "heartbeat_timeout": 1.0, "home": True}


@pytest.fixture(scope="module")
def loop(shared_graph):
    for node, parameters in loop_parameters().items():
        shared_graph.start(node, {**of_node(short_parameters(), node), **parameters})
    return shared_graph


@pytest.fixture
def cell_at_work(loop, participant):
    """A function that starts a cell, acts when the stage moves, and returns what became of it."""

    def started(act, command=None, **parameters):
        loop.log("cell").unlink(missing_ok=True)
        participant.trigger("driver/reset_fault")
        cell = loop.start("cell", {**of_node(short_parameters(), "cell"), **CHOSEN, **parameters}, command=command)
        wait_for_line(loop, "cell", "stage moves")
        act(cell)
        participant.until(lambda: cell.poll() is not None, 120.0)
        participant.until(lambda: not participant.amplifier_on())
        return cell.returncode, loop.log("cell").read_text()

    return started


def publish_nonsense(participant, publisher):
    """No value in diagnostics ends a cycle."""
    participant.until(lambda: publisher.get_subscription_count() > 0)
    for value in ("n/a", "", "nan", "-1", "1e400", "9" * 5000):
        keys = ("samples", "lost_samples", CPU_WAIT, "timer_error_max_us", "excitation")
        values = [KeyValue(key=key, value=value) for key in keys]
        status = [DiagnosticStatus(name=name, values=values) for name in (*RECORDED, "cell")]
        publisher.publish(DiagnosticArray(status=status))


@pytest.mark.parametrize(
    "recoveries, code, words",
    [
        (3, 0, "cycle complete: strokes 1,"),
        pytest.param(0, 1, "amplifier off in mid-cycle: tripped: the door is open", marks=pytest.mark.nightly),
    ],
)
def test_a_fault_in_mid_cycle_is_recovered_from_as_often_as_that_is_allowed(
    cell_at_work, participant, recoveries, code, words
):
    diagnostics = participant.node.create_publisher(DiagnosticArray, DIAGNOSTICS, 100)

    def disturb(cell):
        publish_nonsense(participant, diagnostics)
        participant.trip()

    found, log = cell_at_work(disturb, recoveries=recoveries)
    assert found == code and words in log
    assert ("fault 1: tripped: the door is open; switching on again" in log) is (recoveries > 0)


BROKEN = "from straightcomp_ros.nodes import cell_node as c; c.CellNode._follow_motion = lambda self: [1 / 0]; c.main()"


@pytest.mark.parametrize(
    ("number", "command", "words"),
    [
        (signal.SIGINT, None, "interrupted"),
        pytest.param(signal.SIGTERM, None, "interrupted", marks=pytest.mark.nightly),
        pytest.param(signal.SIGHUP, None, "interrupted", marks=pytest.mark.nightly),
        pytest.param(0, [sys.executable, "-c", BROKEN], "ZeroDivisionError", marks=pytest.mark.nightly),
    ],
)
def test_a_cell_that_is_stopped_or_fails_in_mid_cycle_switches_off_and_does_not_end_with_0(
    cell_at_work, in_a_terminal, participant, number, command, words
):
    def stop(cell):
        if number:
            participant.until(participant.amplifier_on)
            cell.send_signal(number)

    code, log = cell_at_work(stop, command=command)
    assert code == 1 and words in log and "the amplifier has been switched off" in log
    assert not participant.safety[-1].fault


def test_a_graph_whose_nodes_have_different_stages_does_not_move(loop):
    loop.log("cell").unlink(missing_ok=True)
    cell = loop.start("cell", {**of_node(short_parameters(), "cell"), **CHOSEN, "stage.platform.mass": 3.5})
    assert cell.wait(timeout=120) == 1
    log = loop.log("cell").read_text()
    assert "descriptions of the stage differ (cell synthetic" in log and "stage moves" not in log


def test_a_cycle_that_fails_says_which_node_got_no_cpu(monkeypatch):
    monkeypatch.setattr(cell_node, "_REPORTED_S", 0.0)
    cell = cell_node.CellNode.__new__(cell_node.CellNode)
    reports = {
        "driver": {SCHEDULING: REFUSED, CPU_WAIT: "900", "timer_error_max_us": "1200.0"},
        "controller": {SCHEDULING: REFUSED, CPU_WAIT: "181000", "timer_error_max_us": "180000.0"},
    }
    cell._graph = SimpleNamespace(reports=lambda: reports, quiet=lambda seconds: False)
    cell._seen = SimpleNamespace(missing=())
    cell._sequence = SimpleNamespace(state=State.STOPPING)

    def cycle():
        yield
        raise cell_node.CycleFailed("amplifier off in mid-cycle: command_timeout")

    # While the stage comes to rest its amplifier stays on, and so does the cell.
    assert len(list(islice(cell._explained(cycle()), 100))) == 100
    cell._sequence.state = State.STOPPED
    words = "the controller got no CPU for 180 ms.*real-time priority is not permitted"
    for expected in (words, "^amplifier off in mid-cycle: command_timeout$"):
        with pytest.raises(cell_node.CycleFailed, match=expected):
            list(cell._explained(cycle()))
        reports.clear()
