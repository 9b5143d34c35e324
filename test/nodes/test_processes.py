"""Each node as a process: signals and exit codes; and, in this process, what ends a node before it starts."""

import json
import os
import signal
import subprocess
import sys

import pytest
from parameters_of_tests import FORGIVING
from tiers import nightly
from waiting import wait_for_line

from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.nodes import cell_node, controller_node, driver_node, feedforward_node, logger_node
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.runtime.runner import EXIT_CONFIGURATION, run, run_managed

COMPONENTS = {
    "driver": driver_node.DriverComponent,
    "feedforward": feedforward_node.FeedforwardComponent,
    "controller": controller_node.ControllerComponent,
    "logger": logger_node.LoggerComponent,
}


@pytest.fixture
def refusal(capfd, monkeypatch):
    """A function that starts a node which its parameters must end with exit code 2; returns the last line it prints."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def started(node, **parameters):
        arguments = ["--ros-args"]
        for name, value in parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        if node == "cell":
            code = run(node, cell_node.CellNode, arguments)
        else:
            code = run_managed(node, NODE_PARAMETERS[node], COMPONENTS[node], arguments)
        assert code == EXIT_CONFIGURATION
        return capfd.readouterr().err.splitlines()[-1]

    yield started
    for number, handler in before.items():
        signal.signal(number, handler)


EVERYDAY = [("driver", signal.SIGINT), ("logger", signal.SIGTERM)]
SELDOM = [(node, number) for number in (signal.SIGINT, signal.SIGTERM) for node in (*COMPONENTS, "cell")]


@pytest.mark.parametrize(
    ("node", "number"),
    [*EVERYDAY, *nightly(one for one in SELDOM if one not in EVERYDAY)],
)
def test_a_node_stops_on_a_signal_without_a_traceback(single, tmp_path, node, number):
    process = single.start(node, {"output": str(tmp_path / "bag")} if node == "logger" else {})
    wait_for_line(single, node, "ready")
    process.send_signal(number)
    assert process.wait(timeout=120) == 0
    assert "Traceback" not in single.log(node).read_text()
    if node == "logger":
        assert "parameters.yaml" in read_attachments(tmp_path / "bag")


UNKNOWN = ("realtime.priorty", 1, "'realtime.priorty' is unknown; did you mean 'realtime.priority'")


@pytest.mark.parametrize(
    ("node", "name", "value", "words"),
    [
        *((node, *UNKNOWN) for node in (*COMPONENTS, "cell")),
        ("driver", "stage.platform.mass", -1.0, "-1.0 kg is too small; allowed: > 0"),
        ("driver", "stage.rate", "fast", "'fast' Hz is not an integer"),
        ("driver", "hardware", "none", "'none' is not known; allowed: one of simulated"),
        ("feedforward", "stage.guide.file", "nowhere.csv", "nowhere.csv"),
        ("controller", "control.smc.rho", 0.1, "reaching condition (11)"),
        ("controller", "control.law", "pid", "allowed: one of linear, smc"),
        ("controller", "stage.rate", 1000, "the law 'smc' is unstable"),
        ("logger", "topics", "(", "parameter 'topics'"),
        ("cell", "stage.motion.speed", 0, "0.0 m/s is too small"),
    ],
)
def test_an_unknown_parameter_or_refused_value_ends_a_node_with_code_2_and_what_is_allowed(
    refusal, node, name, value, words
):
    # The reaching condition is that of 'smc'.
    law = {"control.law": "smc"} if node == "controller" else {}
    assert words in refusal(node, **{**law, name: value})


def test_the_logger_refuses_a_folder_that_is_not_empty(refusal, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("data")
    assert str(tmp_path) in refusal("logger", output=str(tmp_path)) and precious.read_text() == "data"


def test_gains_without_margins_are_used_with_a_warning_where_that_is_asked_for(single):
    single.start("controller", {"stage.rate": 1000, "control.margins": "warn"})
    wait_for_line(single, "controller", "ready")
    assert "samples late; allowed: >= 1.5" in single.log("controller").read_text()


def test_a_cell_without_a_driver_fails_and_names_what_is_missing(single):
    process = single.start("cell", {"start_timeout": 1.0})
    assert process.wait(timeout=120) == 1
    missing = ", ".join(f"{node} (absent)" for node in ("driver", "feedforward", "controller", "logger"))
    assert f"nodes that do not work: {missing}" in single.last_words("cell")


@pytest.mark.nightly
def test_a_cell_that_the_driver_refuses_to_enable_fails(single, short_cycle):
    # Without a feedforward there is no reference and no command, so the driver refuses to enable.
    single.start("driver", {**short_cycle["driver"], **FORGIVING})
    single.start("controller", short_cycle["controller"])
    for node in ("driver", "controller"):
        wait_for_line(single, node, "ready")
    # Long enough for a busy machine to see both nodes; the refusal comes after as long again.
    cell = single.start("cell", {"nodes": "driver controller", "start_timeout": 10.0})
    assert cell.wait(timeout=120) == 1
    # A busy host may give another reason first, but the amplifier is never on, and the stage never moves.
    assert "cycle failed: " in single.last_words("cell") and "stage moves" not in single.log("cell").read_text()
    assert "enable: amplifier on" not in single.log("driver").read_text()


def test_a_program_that_is_started_again_appends_to_its_log(single):
    for word in ("first", "second"):
        single.start_program("node", [sys.executable, "-c", f"print('{word}')"]).wait(60)
    assert single.log("node").read_text().split() == ["first", "second"] and single.exit_code("node") == 0


BLAS = "import sys, os, straightcomp_ros.nodes; print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"


@pytest.mark.parametrize(("chosen", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_a_node_computes_in_one_thread_unless_its_user_chooses_more(chosen, threads):
    """OpenBLAS's threads wait in busy loops, for ever with real-time priority."""
    others = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    printed = subprocess.check_output([sys.executable, "-c", BLAS], env={**others, **chosen}, text=True, timeout=120)
    # NumPy reads it once, when it is imported.
    assert printed.split() == [threads, "False"]
