"""The gateway in the running graph: a cycle driven through OPC UA alone, and a flood, which costs the loop nothing."""

import importlib.util
import json
import re
import shutil
import subprocess
import time

import pytest
from opcua_probes import command, probed
from participant import Participant
from places import REPOSITORY
from waiting import wait_for_line

from straightcomp_ros.cell.launcher import COMPOSED, IN_THE_LOOP, RECORDED
from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.runtime.graph_client import GraphClient
from straightcomp_ros.runtime.runner import EXIT_CONFIGURATION
from straightcomp_ros.timing.node_timing import LOST, OVERRUNS, SAMPLES, count

if importlib.util.find_spec("asyncua") is None:
    pytest.skip("the extra 'opcua' is not installed", allow_module_level=True)

from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.opcua.admission import OPERATOR, OpcuaParameters, add_user

SLOW = {
    # Few samples and long timeouts: a machine that is busy with other things stalls.
    "stage.rate": 200,
    "driver.simulated.command_timeout": 1.0,
    # At this rate no law holds the platform; what is tried here is the way of the commands.
    "driver.watch.y_limit": 0.1,
    "driver.watch.frozen_current": 100.0,
    "controller.control.margins": "warn",
    "stage.motion.stroke": 0.02,
    "stage.motion.settle": 0.2,
    "stage.motion.pause": 0.1,
    **{f"{node}.realtime.priority": 0 for node in (*RECORDED, "opcua")},
}


@pytest.mark.live
@pytest.mark.nightly
def test_the_demonstration_runs_its_strokes_through_opc_ua_alone(tmp_path, capfd):
    settings = [word for name, value in SLOW.items() for word in ("--set", f"{name}={value}")]
    code = main(["demo", "--opcua", "--strokes", "2", "--json", "-o", str(tmp_path), *settings])
    figures = json.loads(capfd.readouterr().out)
    # At so low a rate no law holds the platform; a busy computer is no failure without priority.
    assert code == (0 if figures["verdict"] in ("in_order", "starved") else 1)
    assert figures["received_samples"] > 200
    log = (tmp_path / "logs" / "opcua.log").read_text()
    states = ("resetting", "idle", "starting", "execute", "complete")
    # With its message, where it has one.
    places = [re.search(rf" {state}(: |$)", log, re.MULTILINE).start() for state in states]
    assert places == sorted(places)


def test_a_client_has_the_map_read_again_and_the_platform_centred_and_sees_due_maintenance(graph, tmp_path):
    survey = tmp_path / "survey.csv"
    shutil.copy(REPOSITORY / "config" / "survey_synthetic.csv", survey)
    users, advice, port = tmp_path / "users", tmp_path / "gantry.json", free_port()
    add_user(users, "ann", "correct horse", OPERATOR)
    advice.write_text(json.dumps({"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]}))
    stage = {name: value for name, value in SLOW.items() if name.startswith("stage.")}
    chosen = {
        node: stage | {name[len(node) + 1 :]: value for name, value in SLOW.items() if name.startswith(f"{node}.")}
        for node in IN_THE_LOOP
    }
    chosen["feedforward"]["stage.guide.file"] = str(survey)
    (tmp_path / "parameters.yaml").write_text(as_parameter_file(chosen))
    graph.start(COMPOSED, {}, tmp_path / "parameters.yaml")
    own = {"opcua.port": port, "opcua.users": str(users), "maintenance_file": str(advice)}
    graph.start("opcua", {**own, **stage, "nodes": " ".join(IN_THE_LOOP)})
    wait_for_line(graph, "opcua", "OPC UA at")
    url = OpcuaParameters(port=port).endpoint

    results = probed("orders", url, survey, timeout=200)
    # A state that nobody asked for has no message.
    assert re.search(r"\]: stopped$", log := graph.log("opcua").read_text(), re.MULTILINE), log
    assert "ReloadMap is not accepted in state Stopped" in results["reload while stopped"]
    assert (results["reload"], results["center"], results["back"]) == ("done", "done", "done")
    assert (results["centred"], results["centred then"]) == (True, False)
    assert "call Center(false) first" in results["start in the middle"]
    assert all(words in results["reload of a spoilt file"] for words in ("BadInvalidState", "survey.csv"))
    assert (results["state"], results["due"]) == ("Idle", "as of 2026-05-01: worn; mend")
    # The map's file was spoilt for the next start alone.
    found = probed("holds", url, survey, timeout=200)
    state, stage, _, amplifier_on, x = found["held"]
    assert (state, stage, amplifier_on) == ("Held", "held", True) and 0.004 < x < 0.02
    assert "Idle" in found["states"] and "Held" in found["states"]
    assert found["end"][0] == "Complete" and found["end"][2] == pytest.approx(30.0)
    assert found["end"][4] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("words", [["--opcua", "--lockstep"], ["--strokes", "0"], ["--opcua", "--strokes", "0"]])
def test_what_a_demonstration_cannot_do_is_refused(words, capfd):
    assert main(["demo", *words]) == EXIT_CONFIGURATION
    assert "allowed" in capfd.readouterr().err


def test_without_users_a_gateway_serves_readers_on_this_machine_and_with_a_wrong_file_it_ends_with_one_sentence(
    single, tmp_path
):
    parameters = node_parameters("opcua", {}).opcua
    assert parameters.on_loopback and not parameters.users
    node = single.start("opcua", {"opcua.users": str(tmp_path / "none")})
    assert node.wait(120) == EXIT_CONFIGURATION
    assert "users file" in single.last_words("opcua") and "Traceback" not in single.log("opcua").read_text()


FLOOD_S, FLOODS, FIRST_ANSWER_S = 3.0, 3, 30.0
LOOPS = ("driver", "controller")
COUNTS = (SAMPLES, LOST, OVERRUNS, "commands")


@pytest.fixture
def grown():
    """A function that returns what each loop's counts in its diagnostics grew by while ``work()`` was done."""
    with Participant("counters") as participant:
        client = GraphClient(participant.node, LOOPS)

        def now():
            before = client.reports()
            participant.until(lambda: all(client.reports().get(loop) not in (None, before.get(loop)) for loop in LOOPS))
            return client.reports()

        def grown(work):
            before, _, after = now(), work(), now()
            return {loop: {one: count(after[loop], one) - count(before[loop], one) for one in COUNTS} for loop in LOOPS}

        yield grown


def flood(url):
    """A flood of some seconds whose clients are killed in the end; returns the requests that were answered."""
    # The load on the gateway is tried, not that of the clients, who are elsewhere.
    storm = ["nice", "-n", "10", *command("storm", url, 12)]
    with subprocess.Popen(storm, stdout=subprocess.PIPE, text=True) as process:
        answered, end = 0, time.monotonic() + FLOOD_S
        try:
            # A machine that is busy with other things leaves the gateway little: then it takes longer.
            while not answered or time.monotonic() < end:
                assert time.monotonic() < end + FIRST_ANSWER_S, "the gateway answers no client"
                answered = int(process.stdout.readline())
        finally:
            process.kill()
    return answered


@pytest.mark.nightly
@pytest.mark.keeps_time
def test_a_flood_of_clients_that_vanish_costs_the_loop_no_sample_and_no_command(graph, short_cycle, grown, capsys):
    """Counted against the bound in docs/opcua.md."""
    port = free_port()
    # What the test itself does to the machine is not to end the run.
    short_cycle["controller"]["sample_timeout"] = 30.0
    for node in IN_THE_LOOP:
        graph.start(node, short_cycle[node])
    graph.start("opcua", {**short_cycle["opcua"], "opcua.port": port, "nodes": " ".join(IN_THE_LOOP)})
    wait_for_line(graph, "opcua", "OPC UA at")
    quiet, answers = grown(lambda: time.sleep(FLOODS * FLOOD_S)), []
    url = OpcuaParameters(port=port).endpoint
    flooded = grown(lambda: answers.extend(flood(url) for _ in range(FLOODS)))
    with capsys.disabled():
        print(f"\nanswered while flooded: {answers}\nquiet: {quiet}\nflooded: {flooded}")
    graph.check(["opcua", *IN_THE_LOOP])

    def missed(grown):
        """Share of the periods that a loop missed."""
        return grown[OVERRUNS] / grown[SAMPLES]

    for loop in LOOPS:
        assert flooded[loop][LOST] == 0
        assert missed(flooded[loop]) <= 2.0 * missed(quiet[loop]) + 0.1
    assert flooded["driver"][SAMPLES] - flooded["driver"]["commands"] <= 0.01 * flooded["driver"][SAMPLES]
