"""Each node as a process: parameters, signals, exit codes."""

import signal

import pytest
from waiting import wait_for_line

from straightcomp_ros.bags.reader import read_attachments

NODES = ("driver", "feedforward", "controller", "logger", "cell")
UNTRACED = pytest.mark.untraced
"""Of a parametrised test the first is traced, or the first of each node: the others go the same way."""


def extra(node, tmp_path):
    return {"output": str(tmp_path / "bag")} if node == "logger" else {}


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=UNTRACED)])
def test_a_node_stops_on_a_signal_within_two_seconds_and_without_a_traceback(single, tmp_path, node, number):
    process = single.start(node, extra(node, tmp_path))
    wait_for_line(single, node, "ready")
    process.send_signal(number)
    assert process.wait(timeout=120) == 0
    assert "Traceback" not in single.log(node).read_text()
    if node == "logger":
        assert "parameters.yaml" in read_attachments(tmp_path / "bag")


@pytest.mark.parametrize("node", [NODES[0], *(pytest.param(node, marks=UNTRACED) for node in NODES[1:])])
def test_an_unknown_parameter_ends_a_node_with_code_2_and_its_name(single, tmp_path, node):
    process = single.start(node, {**extra(node, tmp_path), "realtime.priorty": 1})
    assert process.wait(timeout=120) == 2
    assert "'realtime.priorty' is unknown; did you mean 'realtime.priority'" in single.last_words(node)


# A refusal goes the way of the unknown name above; what is refused, the tests of the core trace.
@UNTRACED
@pytest.mark.parametrize(
    ("node", "name", "value", "words"),
    [
        ("driver", "stage.platform.mass", -1.0, "-1.0 kg is too small; allowed: > 0"),
        ("driver", "stage.rate", "fast", "'fast' Hz is not an integer"),
        ("driver", "hardware", "none", "'none' is not known; allowed: one of simulated"),
        ("feedforward", "stage.guide.file", "nowhere.csv", "nowhere.csv"),
        ("controller", "control.smc.rho", 0.1, "reaching condition (11)"),
        ("controller", "control.law", "pid", "allowed: one of linear, smc"),
        ("controller", "stage.rate", 1000, "the law 'smc' is unstable"),
        ("cell", "stage.motion.speed", 0, "0.0 m/s is too small"),
    ],
)
def test_a_refused_value_ends_a_node_with_code_2_and_what_is_allowed(single, tmp_path, node, name, value, words):
    # The reaching condition is that of 'smc'.
    law = {"control.law": "smc"} if node == "controller" else {}
    process = single.start(node, {**law, name: value})
    assert process.wait(timeout=120) == 2
    assert words in single.last_words(node)


@UNTRACED
def test_gains_without_margins_are_used_with_a_warning_where_that_is_asked_for(single):
    single.start("controller", {"stage.rate": 1000, "control.margins": "warn"})
    wait_for_line(single, "controller", "ready")
    assert "samples late; allowed: >= 1.5" in single.log("controller").read_text()


@UNTRACED
def test_an_integer_is_taken_where_a_float_is_meant(single):
    single.start("driver", {"simulated.command_timeout": 1, "simulated.hold_stiffness": 0})
    wait_for_line(single, "driver", "ready")


def test_the_logger_refuses_a_folder_that_holds_something(single, tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "precious").write_text("data")
    process = single.start("logger", extra("logger", tmp_path))
    assert process.wait(timeout=120) == 2
    assert str(tmp_path / "bag") in single.last_words("logger")
    assert (tmp_path / "bag" / "precious").read_text() == "data"


def test_a_cell_without_a_driver_fails_and_names_what_is_missing(single):
    process = single.start("cell", {"start_timeout": 1.0})
    assert process.wait(timeout=120) == 1
    missing = ", ".join(f"{node} (absent)" for node in ("driver", "feedforward", "controller", "logger"))
    assert f"nodes that do not work: {missing}" in single.last_words("cell")


def test_a_cell_that_the_driver_refuses_to_enable_fails_with_the_reason(single, short_cycle):
    # Without a feedforward there is no reference and no command, so the driver refuses to enable.
    for node in ("driver", "controller"):
        single.start(node, short_cycle[node])
    for node in ("driver", "controller"):
        wait_for_line(single, node, "ready")
    # Long enough for a busy machine to see both nodes; the refusal comes after as long again.
    cell = single.start("cell", {"nodes": "driver controller", "start_timeout": 10.0})
    assert cell.wait(timeout=120) == 1
    assert "no fresh command" in single.last_words("cell")
