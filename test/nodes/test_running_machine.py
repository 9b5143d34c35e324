"""A running graph as a machine: a client that fails, is interrupted or is killed leaves nothing behind."""

import json
import os
import signal
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.cli.main import main
from straightcomp_ros.control.excitation import ExcitationEnded, ExcitationParameters, MultisineParameters
from straightcomp_ros.control.laws import OPEN_LOOP
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.model.motion import MotionParameters, forward_and_back
from straightcomp_ros.model.paced_motion import StageState
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.runtime.safety_panel import SafetyState
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.tuning.commissioning import CommissioningError
from straightcomp_ros.tuning.commissioning import machine as commissioning_machine
from straightcomp_ros.tuning.graph import running_machine
from straightcomp_ros.tuning.graph.running_machine import Access, FirstParameters, RunningMachine

SHIPPED = with_values(shipped_parameters(), "driver", {"watch.travel": 0.1})
LOGGER = {"output": "", "record_at_start": False, "compression": "zstd"}
OFF, ON = SafetyState(), SafetyState(State.ON)
STRAYED = SafetyState(State.FAULT, "following_error: 0.7 mm", Fault.FOLLOWING_ERROR.code)


class Client:
    """Nodes that do what they are asked at once; ``interrupt`` names what raises `KeyboardInterrupt` instead."""

    stage_listens = True
    stage = StageState()
    excitation = "running"
    x = away = 0.0

    def __init__(self, interrupt: str = "", safety: SafetyState = OFF, moved: SafetyState = ON) -> None:
        self.interrupt, self.safety, self.moved = interrupt, safety, moved
        self.given: dict[str, dict[str, object]] = {}
        self.states: dict[str, str] = {}
        self.asked: list[tuple[str, object]] = []
        self.moves: list[object] = []

    def reports(self):
        return {"controller": {"excitation": self.excitation}}

    def observation(self):
        return Observation(x=self.x, fresh=True)

    def wait(self, done, within, otherwise):
        """Time is not waited for; a stage that was sent away comes back meanwhile."""
        self.x, self.away = (self.away or self.x), 0.0
        done()
        self.x = 0.0 if self.moves else self.x

    def bring(self, node, goal):
        self.states[node] = goal

    def give(self, node, values):
        self.given.setdefault(node, {}).update(values)

    def ask(self, kind, service, data=None):
        self.asked.append((service, data))
        if service == "driver/enable":
            self.safety = ON if data else OFF
            if data and self.interrupt == "enable":
                raise KeyboardInterrupt
        return SimpleNamespace(success=True, message="")

    require = ask

    def move(self, waypoints):
        self.moves.append(waypoints)
        self.away = max(point.position for point in waypoints)
        if self.interrupt == "move":
            raise KeyboardInterrupt
        self.safety = self.moved


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    for name in ("_CREEP_S", "_SETTLE_S", "_AFTER_S", "_REPORTED_S"):
        monkeypatch.setattr(running_machine, name, 0.0)


def machine(client: Client, folder: Path) -> RunningMachine:
    return RunningMachine(client, SHIPPED, LOGGER, folder)


def off_at_the_end(client: Client) -> bool:
    return [wanted for service, wanted in client.asked if service == "driver/enable"][-1:] == [False]


def test_strokes_follow_each_other_from_where_they_begin_and_a_released_logger_has_its_first_parameters(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    client = Client()
    used = machine(client, Path("found"))
    used.stroke(SHIPPED, Path("found/bag"), 3e-4, count=3)
    assert len(client.moves) == 3
    assert all(points[0].position == points[-1].position == 0.0 for points in client.moves)
    # The folder is the same wherever the logger was started.
    assert client.given["logger"]["output"] == str(tmp_path / "found" / "bag")
    used.release()
    assert client.given["logger"] == {"output": "", "record_at_start": False}
    loop = dict.fromkeys(("driver", "feedforward", "controller"), "inactive")
    # A cell can configure the logger.
    assert client.states == {**loop, "logger": "unconfigured"}


def test_after_an_interrupt_no_further_stroke_begins_and_the_travel_that_a_killed_client_left_was_taken_back(tmp_path):
    client = Client(interrupt="move")
    client.given["driver"] = {"watch.travel": 3e-6}
    with pytest.raises(KeyboardInterrupt):
        machine(client, tmp_path).stroke(SHIPPED, tmp_path / "bag", 3e-4, count=100)
    (points,) = client.moves
    assert list(points) == forward_and_back(MotionParameters()) and off_at_the_end(client)
    assert client.given["driver"]["watch.travel"] == 0.1


def test_a_stage_that_makes_no_stroke_is_named_and_one_a_little_off_its_start_goes_there_first(tmp_path):
    client = Client()
    client.move = client.moves.append
    with pytest.raises(CommissioningError, match="'stage_trajectory'"):
        machine(client, tmp_path).stroke(SHIPPED, tmp_path / "bag", 3e-4)
    assert off_at_the_end(client)
    client = Client()
    client.x = 5e-6
    machine(client, tmp_path).stroke(SHIPPED, tmp_path / "bag", 3e-4)
    assert [points[0].position for points in client.moves] == [5e-6, 0.0]


def test_a_machine_that_fell_silent_is_released_all_the_same(tmp_path):
    client = Client()
    used = machine(client, tmp_path)
    used.stroke(SHIPPED, tmp_path / "bag", 3e-4)

    def silent(done, within, otherwise):
        raise CommissioningError(otherwise)

    client.wait = silent
    used.release()
    assert client.given["logger"] == {"output": "", "record_at_start": False}
    assert set(client.states.values()) == {"inactive", "unconfigured"}
    # Nor does a node that has ended keep the others.
    client.given["logger"], bring = {}, client.bring

    def lacking(node, goal):
        if node == "controller":
            raise CommissioningError("it has ended")
        bring(node, goal)

    client.bring, client.states = lacking, {"driver": "active", "feedforward": "active"}
    with pytest.raises(CommissioningError, match="ended"):
        used.release()
    assert client.given["logger"] == {"output": "", "record_at_start": False}
    assert set(client.states.values()) == {"inactive", "unconfigured"}


def test_a_graph_that_learns_does_not_in_open_loop_and_an_interrupt_at_switching_on_gives_all_back(tmp_path):
    client = Client(interrupt="enable")
    learning = {"learning.learn": True, "learning.file": str(tmp_path / "learned.csv")}
    used = RunningMachine(client, with_values(SHIPPED, "controller", learning), LOGGER, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        used.play(ExcitationParameters(signal="shake"))
    assert off_at_the_end(client)
    assert client.given["driver"]["watch.travel"] != ExcitationParameters().travel
    controller = client.given["controller"]
    assert controller["control.law"] == OPEN_LOOP and not controller["learning.learn"]
    # Nor under a test signal.
    with pytest.raises(KeyboardInterrupt):
        used.response(SHIPPED, MultisineParameters(draws=3), moving=True)
    assert controller["control.law"] != OPEN_LOOP and not controller["learning.learn"]
    used.release()
    assert controller["control.law"] != OPEN_LOOP and controller["learning.learn"]


def test_a_platform_that_strays_in_a_frequency_response_ended_the_excitation(tmp_path):
    client = Client(moved=STRAYED)
    with pytest.raises(ExcitationEnded, match="following_error"):
        machine(client, tmp_path).response(SHIPPED, MultisineParameters(draws=3), moving=True)
    assert off_at_the_end(client)


def test_an_excitation_that_ended_early_is_not_waited_for_and_ended_for_the_controllers_reason(tmp_path, monkeypatch):
    client, swing = Client(), 4e-4 * np.sin(np.arange(400) * 0.1) * np.linspace(0.0, 1.0, 400)
    client.excitation = "y − r changed by 302 µm; allowed: 300 µm"
    held = np.zeros(200)

    def lacking(bag, *_):
        raise ExcitationEnded("not the whole excitation")

    def recorded(bag):
        off = np.full(50, 3e-3)
        y = np.concatenate([off, held, swing, held, off])
        command = np.where(y == 3e-3, np.nan, 0.0)
        return SimpleNamespace(y=y, command=command)

    monkeypatch.setattr(running_machine, "response_from_bag", lacking)
    monkeypatch.setattr(commissioning_machine, "recorded_series", recorded)
    # A stroke of each cycle would be waited for.
    with pytest.raises(ExcitationEnded, match=r"not the whole excitation.*302 µm") as raised:
        machine(client, tmp_path).response(SHIPPED, MultisineParameters(), moving=True)
    assert not client.moves[1:] and off_at_the_end(client)
    # What swung then is looked at, and neither how it was held afterwards nor where it lay before.
    reading = raised.value.reading
    assert reading.size and abs(reading[-1]) > 3e-4 and np.abs(reading).max() < 4.1e-4
    # The whole one finished, and lost samples.
    client.excitation = "finished"
    with pytest.raises(ExcitationEnded, match=r"not the whole excitation$"):
        machine(client, tmp_path).response(SHIPPED, MultisineParameters(draws=3))


def test_a_machine_in_use_is_left_as_it_is(tmp_path):
    client = Client(safety=ON)
    with pytest.raises(CommissioningError, match="another client uses the machine"):
        machine(client, tmp_path)
    assert not client.asked and not client.given and not client.states


@pytest.mark.parametrize(("stage", "words"), [(StageState("held"), "held"), (StageState(override=0.5), "override")])
def test_a_stage_that_its_operator_has_held_or_slowed_down_makes_no_strokes(tmp_path, stage, words):
    client = Client()
    client.stage = stage
    used = machine(client, tmp_path)
    for make in (
        lambda: used.listen(1.0),
        lambda: used.stroke(SHIPPED, tmp_path / "bag", 3e-4),
        lambda: used.response(SHIPPED, MultisineParameters(), moving=True),
    ):
        with pytest.raises(CommissioningError, match=words):
            make()
    assert not client.moves and not any(on for _, on in client.asked)


def test_a_stage_that_was_held_at_rest_or_is_held_on_its_way_ends_the_strokes(tmp_path):
    client = Client()
    begin = client.move

    def held(waypoints):
        begin(waypoints)
        client.stage = StageState("held")

    client.move = held
    with pytest.raises(CommissioningError, match="held"):
        machine(client, tmp_path).stroke(SHIPPED, tmp_path / "bag", 3e-4, count=3)
    assert len(client.moves) == 1 and off_at_the_end(client)


FOUND = {"driver": {"watch.travel": 0.1, "hardware": "simulated"}, "logger": {"output": ""}}
LEFT = {"driver": {"watch.travel": 3e-6, "hardware": "simulated"}, "logger": {"output": "bags/shake"}}
PROCESSES = {"driver": "01", "logger": "02"}


def test_the_next_client_finds_what_a_killed_one_found_but_for_nodes_started_anew_or_released(tmp_path, monkeypatch):
    monkeypatch.setattr(running_machine, "private_folder", lambda: tmp_path)
    first = FirstParameters(FOUND, PROCESSES)
    first.keep()
    assert FirstParameters(LEFT, PROCESSES).values == FOUND
    anew = FirstParameters({**LEFT, "driver": {"watch.travel": 0.2}}, {**PROCESSES, "driver": "03"})
    assert anew.values == {"driver": {"watch.travel": 0.2}, "logger": FOUND["logger"]}
    # A file of nonsense counts for nothing.
    for file in tmp_path.iterdir():
        file.write_text(json.dumps(FOUND)[:20])
    assert FirstParameters(LEFT, PROCESSES).values == LEFT
    first.keep()
    first.forget()
    assert not list(tmp_path.iterdir())
    assert FirstParameters(LEFT, PROCESSES).values == LEFT


def failed():
    raise CommissioningError("no samples come")


@pytest.fixture
def stands_for_graph(monkeypatch):
    """A function that puts ``act`` in the place of a running graph's use by a verb; returns what became of that."""

    def stands_for(act):
        seen = SimpleNamespace(folder=None, released=False)

        @contextmanager
        def running(folder, namespace=""):
            seen.folder = folder
            try:
                yield Access(None, shipped_parameters(), lambda doing: act())
            finally:
                with suppress(CommissioningError):
                    # A signal that comes twice.
                    act()
                seen.released = True

        monkeypatch.setattr(running_machine, "running_graph", running)
        return seen

    return stands_for


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_and_a_closed_terminal_release_the_machine_even_if_they_come_twice(
    stands_for_graph, in_a_terminal, capsys, number
):
    before = [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGHUP)]
    one = stands_for_graph(partial(os.kill, os.getpid(), number))
    assert main(["frequency-response", "--graph", "running"]) == 143
    assert one.released and "terminated" in capsys.readouterr().err
    assert [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGHUP)] == before


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        # A measurement that fails leaves what was there before.
        ("frequency-response --graph running -o loop.png", "loop_graph/unfinished"),
        ("commission --graph running -o found --only connection", "found"),
    ],
)
def test_nodes_get_the_whole_path_of_a_folder_and_are_released_after_a_failure(
    stands_for_graph, tmp_path, monkeypatch, words, folder
):
    monkeypatch.chdir(tmp_path)
    one = stands_for_graph(failed)
    assert main(words.split()) == 1
    assert one.folder == tmp_path / folder and one.released
