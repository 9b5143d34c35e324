"""The gateway in the running graph: a cycle that a client in another process drives through OPC UA alone."""

import importlib.util
import json

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.configuration import OpcuaNodeParameters, node_parameters
from straightcomp_ros.nodes.runner import EXIT_CONFIGURATION

if importlib.util.find_spec("asyncua") is None:
    pytest.skip("the extra 'opcua' is not installed", allow_module_level=True)

SLOW = {
    # Few samples and long timeouts: a machine that is busy with other things stalls.
    "driver.simulated.rate": 200,
    "driver.simulated.command_timeout": 1.0,
    # At this rate no law holds the platform; what is tried here is the way of the commands.
    "driver.watch.y_limit": 0.1,
    "driver.watch.frozen_current": 100.0,
    "controller.rate": 200,
    "controller.reference_lead": 1,
    "cell.motion.stroke": 0.02,
    "cell.motion.settle": 0.2,
    "cell.motion.pause": 0.1,
    **{f"{node}.realtime.priority": 0 for node in ("driver", "feedforward", "controller", "logger", "opcua")},
}


def test_the_demonstration_runs_its_strokes_through_opc_ua_alone(tmp_path, capfd):
    settings = [word for name, value in SLOW.items() for word in ("--set", f"{name}={value}")]
    assert main(["demo", "--opcua", "--strokes", "2", "--json", "-o", str(tmp_path), *settings]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["received_samples"] > 200
    told = (tmp_path / "logs" / "opcua.log").read_text()
    states = ["resetting", "idle", "starting", "execute", "complete"]
    places = [told.index(f" {state}: ") for state in states]
    assert places == sorted(places)


@pytest.mark.parametrize("words", [["--opcua", "--lockstep"], ["--strokes", "0"], ["--opcua", "--strokes", "0"]])
def test_what_a_demonstration_cannot_do_is_refused(words, capfd):
    assert main(["demo", *words]) == EXIT_CONFIGURATION
    assert "allowed" in capfd.readouterr().err


def test_a_gateway_without_users_serves_readers_on_this_machine():
    parameters = node_parameters("opcua", {})
    assert isinstance(parameters, OpcuaNodeParameters)
    assert parameters.opcua.on_loopback and not parameters.opcua.users


def test_wrong_parameters_end_the_node_with_one_sentence(graph, tmp_path):
    node = graph.start("opcua", {"opcua.users": str(tmp_path / "none")})
    assert node.wait(90) == EXIT_CONFIGURATION
    assert "users file" in graph.last_words("opcua") and "Traceback" not in graph.log("opcua").read_text()
