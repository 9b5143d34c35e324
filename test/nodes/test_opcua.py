"""The gateway in the running graph: a cycle driven through OPC UA alone, and a flood, which costs the loop nothing."""

import asyncio
import importlib.util
import json
import re
import shutil
import time

import pytest
from participant import Participant
from places import REPOSITORY
from waiting import wait_for_line

from straightcomp_ros.cell.launcher import COMPOSED, IN_THE_LOOP, RECORDED
from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import as_parameter_file
from straightcomp_ros.runtime.graph_client import GraphClient
from straightcomp_ros.timing.node_timing import LOST, OVERRUNS, SAMPLES, count

if importlib.util.find_spec("asyncua") is None:
    pytest.skip("the extra 'opcua' is not installed", allow_module_level=True)

from opcua_clients import OPERATOR, flood, probing

from straightcomp_ros.cell.demonstration import free_port
from straightcomp_ros.cell.packml import Command, Order, State
from straightcomp_ros.opcua.admission import OpcuaParameters, add_user
from straightcomp_ros.opcua.client import CycleFailed, connected

SLOW = {
    # Few samples and long timeouts: a machine that is busy with other things stalls.
    "stage": {"rate": 200, "motion.stroke": 0.02, "motion.settle": 0.2, "motion.pause": 0.1},
    # At this rate no law holds the platform; what is tried here is the way of the commands.
    "driver": {"simulated.command_timeout": 1.0, "watch.y_limit": 0.1, "watch.frozen_current": 100.0},
    "controller": {"control.margins": "warn"},
}


@pytest.mark.live
@pytest.mark.nightly
def test_the_demonstration_runs_its_strokes_through_opc_ua_alone(tmp_path, capfd):
    given = {f"{section}.{name}": value for section, chosen in SLOW.items() for name, value in chosen.items()}
    given |= {f"{node}.realtime.priority": 0 for node in (*RECORDED, "opcua")}
    settings = [word for name, value in given.items() for word in ("--set", f"{name}={value}")]
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


@pytest.fixture
def machine(graph, tmp_path):
    """A graph in one process and a gateway to it; its endpoint, and the file of the map."""
    survey = tmp_path / "survey.csv"
    shutil.copy(REPOSITORY / "config" / "survey_synthetic.csv", survey)
    users, advice, port = tmp_path / "users", tmp_path / "gantry.json", free_port()
    add_user(users, *OPERATOR, "operator")
    advice.write_text(json.dumps({"stage": "a", "as_of": "2026-05-01", "advice": [{"text": "worn", "remedy": "mend"}]}))
    own = {"opcua.port": port, "opcua.users": str(users), "maintenance_file": str(advice)}
    values = {**SLOW, "stage": {**SLOW["stage"], "guide.file": str(survey)}}
    values["opcua"] = {**own, "nodes": " ".join(IN_THE_LOOP)}
    (file := tmp_path / "parameters.yaml").write_text(as_parameter_file(values))
    for process in (COMPOSED, "opcua"):
        graph.start(process, {}, file)
    wait_for_line(graph, "opcua", "OPC UA at")
    return OpcuaParameters(port=port).endpoint, survey


@probing
async def test_a_client_has_the_map_read_again_and_the_platform_centred_and_sees_due_maintenance_and_holds_a_stroke(
    machine, graph
):
    url, survey = machine

    async def refusal(*command):
        # A change of reference that is under way refuses the next one for half a second.
        for _ in range(50):
            try:
                return await cell.command(*command) or ""
            except CycleFailed as refused:
                if "previous change" not in str(refused):
                    return str(refused)
            await asyncio.sleep(0.2)

    async def until(state, x=-1.0):
        end = time.monotonic() + 60.0
        while not (await cell.state() is state and await cell.read("Live.X") > x):
            assert time.monotonic() < end, (state, await cell.state(), await cell.read("Live.X"))
            await asyncio.sleep(0.01)

    async with connected(url, *OPERATOR) as cell:
        # A state that nobody asked for has no message.
        assert re.search(r"\]: stopped$", log := graph.log("opcua").read_text(), re.MULTILINE), log
        assert "ReloadMap is not accepted in state Stopped" in await refusal(Order.RELOAD_MAP)
        await cell.command(Command.RESET)
        await until(State.IDLE)
        assert [await refusal(Order.RELOAD_MAP), await refusal(Order.CENTER, True)] == ["", ""]
        assert await cell.read("Status.Centred") is True
        assert "call Center(false) first" in await refusal(Command.START, 1)
        assert await refusal(Order.CENTER, False) == "" and await cell.read("Status.Centred") is False
        survey.write_text("no map")
        spoilt = await refusal(Order.RELOAD_MAP)
        assert "BadInvalidState" in spoilt and "survey.csv" in spoilt
        assert await cell.state() is State.IDLE
        assert await cell.read("Alarms.MaintenanceDue") == "as of 2026-05-01: worn; mend"
        # The map's file was spoilt for the next start alone.
        await cell.command(Order.OVERRIDE, 10)
        await cell.command(Command.START, 1)
        await until(State.EXECUTE, x=0.004)
        await cell.command(Command.HOLD)
        await until(State.HELD)
        await asyncio.sleep(0.5)
        assert await cell.read("Status.StageState") == "held" and await cell.read("Status.AmplifierOn")
        assert 0.004 < await cell.read("Live.X") < 0.02
        await cell.command(Order.OVERRIDE, 30)
        await cell.command(Command.UNHOLD)
        await until(State.COMPLETE)
        assert await cell.read("Status.Override") == pytest.approx(30.0)
        assert await cell.read("Live.X") == pytest.approx(0.0, abs=1e-6)


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


def flooded_for_a_while(url):
    """A flood of some seconds whose clients are killed in the end; returns the requests that were answered."""
    # The load on the gateway is tried, not that of the clients, who are elsewhere.
    with flood(url, 12, 10) as process:
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
    flooded = grown(lambda: answers.extend(flooded_for_a_while(url) for _ in range(FLOODS)))
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
