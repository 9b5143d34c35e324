"""Access to a graph as a machine: what a killed client left is not taken for the machine's; verbs release it."""

import json
import os
import signal
from contextlib import contextmanager

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.commissioning import CommissioningError
from straightcomp_ros.tuning.graph import machine_access
from straightcomp_ros.tuning.graph.machine_access import Access, FirstParameters

FOUND = {"driver": {"watch.travel": 0.1, "hardware": "simulated"}, "logger": {"output": ""}}
LEFT = {"driver": {"watch.travel": 3e-6, "hardware": "simulated"}, "logger": {"output": "bags/shake"}}
PROCESSES = {"driver": "01", "logger": "02"}


def test_the_next_client_finds_what_a_killed_one_found_but_for_nodes_started_anew_or_released(tmp_path):
    first = FirstParameters(FOUND, PROCESSES, tmp_path)
    first.keep()
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == FOUND
    anew = FirstParameters({**LEFT, "driver": {"watch.travel": 0.2}}, {**PROCESSES, "driver": "03"}, tmp_path)
    assert anew.values == {"driver": {"watch.travel": 0.2}, "logger": FOUND["logger"]}
    # A file of nonsense counts for nothing.
    for file in tmp_path.iterdir():
        file.write_text(json.dumps(FOUND)[:20])
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == LEFT
    first.keep()
    first.forget()
    assert not list(tmp_path.iterdir())
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == LEFT


class StandIn:
    """Stands for a running graph. ``act`` is what is done while a verb uses its machine."""

    def __init__(self, act) -> None:
        self.act, self.folder, self.released = act, None, False

    @contextmanager
    def running(self, folder, namespace=""):
        self.folder = folder
        try:
            yield Access(None, shipped_parameters(), lambda doing: self.act())
        finally:
            if self.act is terminate:
                terminate()
            self.released = True


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def failed():
    raise CommissioningError("no samples come")


@pytest.fixture
def stands_for_graph(monkeypatch):
    def stands_for(act):
        one = StandIn(act)
        monkeypatch.setattr(machine_access, "running_graph", one.running)
        return one

    return stands_for


def test_sigterm_releases_the_machine_even_if_it_comes_twice(stands_for_graph, capsys):
    before, one = signal.getsignal(signal.SIGTERM), stands_for_graph(terminate)
    assert main(["frequency-response", "--graph", "running"]) == 143
    assert one.released and "terminated" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


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
