"""The control loop while clients flood the gateway and vanish: counted against the bound in docs/opcua.md."""

import importlib.util
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from participant import Participant
from rclpy.time import Time
from waiting import wait_for_line

from straightcomp_ros.contract import DIAGNOSTICS
from straightcomp_ros.timing.node_timing import LOST, OVERRUNS, SAMPLES

if importlib.util.find_spec("asyncua") is None:
    pytest.skip("the extra 'opcua' is not installed", allow_module_level=True)

from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.opcua.admission import OpcuaParameters

pytestmark = [pytest.mark.keeps_time, pytest.mark.nightly]
REPOSITORY = Path(__file__).resolve().parents[2]
PROBES = REPOSITORY / "test" / "opcua" / "probes.py"
FLOOD_S = 3.0
FLOODS = 3
FIRST_ANSWER_S = 30.0
NODES = ("driver", "feedforward", "controller")
LOOPS = ("driver", "controller")
COUNTS = (SAMPLES, LOST, OVERRUNS, "commands")


@pytest.fixture
def grown():
    """A function that returns what each loop's counts in its diagnostics grew by while ``work()`` was done."""
    with Participant("counters") as participant:
        values, stamps = {}, {}

        def note(message):
            for status in message.status:
                found = {one.key: one.value for one in status.values}
                values[status.name] = {name: int(found.get(name, 0)) for name in COUNTS}
                stamps[status.name] = Time.from_msg(message.header.stamp).nanoseconds

        participant.node.create_subscription(DiagnosticArray, DIAGNOSTICS, note, 10)

        def now():
            begin_ns = time.time_ns()
            participant.until(lambda: all(stamps.get(loop, 0) > begin_ns for loop in LOOPS))
            return {loop: dict(values[loop]) for loop in LOOPS}

        def grown(work):
            before = now()
            work()
            after = now()
            return {loop: {name: after[loop][name] - before[loop][name] for name in COUNTS} for loop in LOOPS}

        yield grown


def flood(url):
    """A flood of some seconds whose clients are killed in the end; returns the requests that were answered."""
    process = subprocess.Popen(
        # The load on the gateway is tried, not that of the clients, who are elsewhere.
        ["nice", "-n", "10", sys.executable, str(PROBES), "storm", url, "12"],
        stdout=subprocess.PIPE,
        text=True,
    )
    answered, end = 0, time.monotonic() + FLOOD_S
    try:
        # A machine that is busy with other things leaves the gateway little: then it takes longer.
        while not answered or time.monotonic() < end:
            assert time.monotonic() < end + FIRST_ANSWER_S, "the gateway answers no client"
            answered = int(process.stdout.readline())
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    return answered


def test_a_flood_of_clients_that_vanish_costs_the_loop_no_sample_and_no_command(graph, short_cycle, grown, capsys):
    port = free_port()
    # What the test itself does to the machine is not to end the run.
    short_cycle["controller"]["sample_timeout"] = 30.0
    for node in NODES:
        graph.start(node, short_cycle[node])
    graph.start("opcua", {**short_cycle["opcua"], "opcua.port": port, "nodes": " ".join(NODES)})
    wait_for_line(graph, "opcua", "OPC UA at")
    quiet = grown(lambda: time.sleep(FLOODS * FLOOD_S))
    answers = []
    url = OpcuaParameters(port=port).endpoint
    flooded = grown(lambda: answers.extend(flood(url) for _ in range(FLOODS)))
    with capsys.disabled():
        print(f"\nanswered while flooded: {answers}\nquiet: {quiet}\nflooded: {flooded}")
    graph.check(["opcua", *NODES])
    for loop in LOOPS:
        assert flooded[loop][LOST] == 0
        assert missed(flooded[loop]) <= 2.0 * missed(quiet[loop]) + 0.1
    assert flooded["driver"][SAMPLES] - flooded["driver"]["commands"] <= 0.01 * flooded["driver"][SAMPLES]


def missed(grown):
    """Share of the periods that a loop missed."""
    return grown[OVERRUNS] / grown[SAMPLES]
