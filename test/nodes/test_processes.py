"""Each node as a process: signals and exit codes; and, in this process, what ends a node before it starts."""

import gc
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
import weakref
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from participant import spun
from rclpy.lifecycle import TransitionCallbackReturn
from tiers import nightly
from waiting import wait_for_line

from straightcomp_ros.bags.reader import read_attachments
from straightcomp_ros.cell.launcher import verb_command
from straightcomp_ros.contract import ENCODER
from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.learning import Learning, LearningParameters
from straightcomp_ros.nodes import (
    cell_node,
    controller_node,
    driver_node,
    feedforward_node,
    logger_node,
    opcua_node,
    player_node,
)
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, FeedforwardNodeParameters
from straightcomp_ros.runtime.loops import WorkerThread, awaited
from straightcomp_ros.runtime.managed import ManagedNode
from straightcomp_ros.runtime.runner import EXIT_CONFIGURATION, run_managed
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.timing.node_timing import EXCITING

MANAGED = {
    one[0]: one
    for one in (driver_node.DRIVER, feedforward_node.FEEDFORWARD, controller_node.CONTROLLER, logger_node.LOGGER)
}

OTHERS = {"cell": cell_node.main, "opcua": opcua_node.main, "player": player_node.main}

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def refusal(capfd, monkeypatch):
    """A function that starts a node which its parameters must end with exit code 2; returns the last line it prints."""
    before = {number: signal.getsignal(number) for number in STOPPING}

    def started(node, **parameters):
        arguments = ["--ros-args"]
        for name, value in parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        start = OTHERS.get(node) or partial(run_managed, [MANAGED[node]])
        assert start(arguments=arguments) == EXIT_CONFIGURATION
        # Until then the node is part of its graph: a cell of a later test would wait for it.
        gc.collect()
        return capfd.readouterr().err.splitlines()[-1]

    yield started
    for number, handler in before.items():
        signal.signal(number, handler)


EVERYDAY = [("driver", signal.SIGINT), ("logger", signal.SIGTERM), ("logger", signal.SIGHUP)]
SELDOM = [(node, number) for number in STOPPING for node in (*MANAGED, "cell")]


@pytest.mark.parametrize(
    ("node", "number"),
    [*EVERYDAY, *nightly(one for one in SELDOM if one not in EVERYDAY)],
)
def test_a_node_stops_on_a_signal_without_a_traceback(single, in_a_terminal, tmp_path, node, number):
    process = single.start(node, {"output": str(tmp_path / "bag")} if node == "logger" else {})
    wait_for_line(single, node, "ready")
    process.send_signal(number)
    assert process.wait(timeout=120) == 0
    assert "Traceback" not in single.log(node).read_text()
    if node == "logger":
        assert "parameters.yaml" in read_attachments(tmp_path / "bag")


def test_a_driver_goes_through_all_states_and_back_and_wrong_transitions_are_refused(single, participant):
    process = single.start("driver", {"stage.rate": 200, "autostart": False})
    assert not participant.change("driver", "activate") and participant.state("driver") == "unconfigured"
    # What cannot be configured stays as it is; the next attempt takes what was corrected.
    assert participant.set("driver", {"simulated.truth.guide": "nowhere.csv"}).successful
    assert not participant.change("driver", "configure") and participant.state("driver") == "unconfigured"
    assert participant.set("driver", {"simulated.truth.guide": "config/guide_synthetic.csv"}).successful
    way = {"configure": "inactive", "activate": "active", "deactivate": "inactive", "cleanup": "unconfigured"}
    for label, state in [*way.items(), *way.items(), ("shutdown", "finalized")]:
        assert participant.change("driver", label) and participant.state("driver") == state
        if label == "configure":
            assert not participant.enable().success
        if label == "activate":
            participant.received(ENCODER)
        if label == "cleanup":
            # The service stays. If it ended and came again, the next request could be lost between the two.
            assert "not configured" in participant.enable().message
    assert process.poll() is None
    assert single.stop(["driver"])["driver"] == 0


def test_a_controller_keeps_what_it_learned_while_the_file_cannot_be_written(single, participant, tmp_path):
    folder = tmp_path / "learned"
    file = folder / "table.csv"
    learning = {"learning.learn": True, "learning.file": str(file), "autostart": False}
    single.start("controller", learning)
    assert not participant.change("controller", "configure")
    assert f"'learning.file': '{file}' cannot be written" in single.log("controller").read_text()
    folder.mkdir()
    first = Learning(LearningParameters(file=str(file)), ControllerNodeParameters().control.law, 2000.0)
    nodes = np.full(20, 1e-8)
    first.tables[True].restore(0, nodes, nodes, nodes, nodes)
    first.save()
    written = file.read_bytes()
    assert participant.change("controller", "configure") and participant.change("controller", "activate")
    file.unlink()
    file.mkdir()
    assert participant.change("controller", "deactivate") and participant.state("controller") == "inactive"
    assert "Is a directory; what was learned is not saved: it stays in memory" in single.log("controller").read_text()
    file.rmdir()
    assert participant.change("controller", "cleanup")
    assert file.read_bytes() == written
    assert single.stop(["controller"])["controller"] == 0


def test_a_controller_saves_what_it_learned_when_the_last_pass_has_been_learned():
    done, worker = [], WorkerThread(pytest.fail)
    worker.run(lambda: time.sleep(0.2))
    worker.run(lambda: done.append("learned"))
    learning = SimpleNamespace(save=lambda: done.append("saved"))
    ends = dict.fromkeys(("_publish_command", "_publish_state"), Mock())
    controller_node.ControllerComponent.deactivate(SimpleNamespace(_worker=worker, _learning=learning, **ends))
    worker.close()
    assert done == ["learned", "saved"]


def test_an_excitation_ends_when_the_samples_end_so_that_a_new_driver_may_be_activated():
    servo = SimpleNamespace(running=True, inject=Mock())
    injection = Injection(np.ones(100), fade=10, limit=1.0, travel=1.0)
    service = controller_node.ExcitationService(Mock(), servo, lambda: injection, Mock())
    service._on_excite(True)
    silent = {"_samples_seen": 7, "_seen": 7, "_silent": 0, "_silence_looks": 2, "_excitation": service}
    parameters = SimpleNamespace(sample_timeout=0.03)
    controller = SimpleNamespace(**silent, _node=SimpleNamespace(active=True), _trip=Mock(), _parameters=parameters)
    for reported in (EXCITING, "samples were missing"):
        controller_node.ControllerComponent._look_for_silence(controller)
        service.look()
        assert service.state == reported
    assert controller._trip.call_args.args[0] is Fault.SAMPLE_TIMEOUT


WITH_ASYNCUA = pytest.mark.skipif(
    importlib.util.find_spec("asyncua") is None, reason="the extra 'opcua' is not installed"
)
UNKNOWN = ("realtime.priorty", 1, "'realtime.priorty' is unknown; did you mean 'realtime.priority'")


@pytest.mark.parametrize(
    ("node", "name", "value", "words"),
    [
        ("logger", *UNKNOWN),
        ("cell", *UNKNOWN),
        ("driver", "hardware", "none", "'none' is not known; allowed: one of simulated"),
        ("feedforward", "stage.guide.file", "nowhere.csv", "nowhere.csv"),
        ("controller", "control.smc.rho", 0.1, "reaching condition (11)"),
        ("controller", "stage.rate", 1000, "the law 'smc' is unstable"),
        ("logger", "topics", "(", "parameter 'topics'"),
        ("logger", "nodes", "driver, controller", "'driver,' is no name of a node; allowed: "),
        ("cell", "nodes", "driver, controller", "'driver,' is no name of a node; allowed: "),
        ("cell", "stage.motion.speed", 0, "0.0 m/s is too small"),
        ("cell", "stage.motion.steps", 100, "parameter 'strokes': 33 "),
        ("player", "bag", "nowhere", "bag nowhere does not exist"),
        pytest.param("opcua", "opcua.users", "nowhere", "users file", marks=WITH_ASYNCUA),
    ],
)
def test_an_unknown_parameter_or_refused_value_ends_a_node_with_code_2_and_what_is_allowed(
    refusal, node, name, value, words
):
    # The reaching condition is that of 'smc'.
    others = {"controller": {"control.law": "smc"}, "cell": {"strokes": 33}}
    assert words in refusal(node, **{**others.get(node, {}), name: value})


def test_what_keeps_a_node_from_being_configured_ends_it_with_code_2_and_its_words_whatever_it_is(refusal, monkeypatch):
    def fail(node, parameters):
        raise ZeroDivisionError("nothing to divide by")

    name, parameters, _ = MANAGED["logger"]
    monkeypatch.setitem(MANAGED, "logger", (name, parameters, fail))
    assert refusal("logger") == "logger: ZeroDivisionError: nothing to divide by"


@pytest.mark.parametrize("kind", MANAGED)
def test_what_a_node_had_is_freed_before_it_is_configured_again(participant, tmp_path, monkeypatch, kind):
    """Otherwise the former machine or map would be in memory beside the new one."""
    name, parameters, make = MANAGED[kind]
    made, left = [], []

    def noted(node, given):
        left.append([one() for one in made if one() is not None])
        component = make(node, given)
        made.append(weakref.ref(component))
        return component

    monkeypatch.chdir(tmp_path)
    node = ManagedNode(name, parameters, noted)
    with spun(node):
        node.begin()
        node.trigger_deactivate()
        node.trigger_cleanup()
        participant.spin(0.3)
        assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
        node.trigger_cleanup()
        node.close()
    assert left == [[], []]


def test_timers_and_so_heartbeats_go_on_while_a_callback_waits_for_what_takes_long(participant):
    node, calls = ManagedNode(*MANAGED["feedforward"]), []
    node.create_timer(0.02, lambda: calls.append(time.monotonic()))
    awaited(partial(time.sleep, 0.5), node.go_on)
    node.destroy_node()
    assert len(calls) > 5


def test_a_change_of_map_does_not_cut_one_short_that_begins_while_the_map_is_read(monkeypatch):
    node, parameters = Mock(), from_mapping(FeedforwardNodeParameters, {})
    monkeypatch.setattr(feedforward_node, "Diagnostics", Mock())
    component = feedforward_node.FeedforwardComponent(node, parameters)
    component._feedforward.step(0, 0.1)
    component._on_center(True)
    monkeypatch.setattr(feedforward_node, "awaited", lambda load, _: component._feedforward.step(1, 0.1) and load())
    with pytest.raises(ParameterError, match="previous change"):
        component.prepare(parameters)


def test_gains_without_margins_are_used_with_a_warning_where_that_is_asked_for(single):
    single.start("controller", {"stage.rate": 1000, "control.margins": "warn"})
    wait_for_line(single, "controller", "ready")
    assert "samples late; allowed: >= 1.5" in single.log("controller").read_text()


def test_a_view_without_a_graph_says_in_which_domain_it_looks(single):
    single.start_program("view", verb_command("view", "--port", "0", "--namespace", "alone"))
    domain = os.environ["ROS_DOMAIN_ID"]
    wait_for_line(single, "view", f"no node of the graph is seen in ROS domain {domain}, namespace /alone")


BLAS = "import sys, os, straightcomp_ros; print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"


@pytest.mark.parametrize(("chosen", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_the_package_computes_in_one_thread_unless_its_user_chooses_more(chosen, threads):
    """OpenBLAS's threads wait in busy loops, for ever with real-time priority, and a map's last bits depend on them."""
    others = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    printed = subprocess.check_output([sys.executable, "-c", BLAS], env={**others, **chosen}, text=True, timeout=120)
    # NumPy reads it once, when it is imported.
    assert printed.split() == [threads, "False"]
