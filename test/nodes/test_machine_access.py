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


def test_the_next_client_finds_the_parameters_that_the_killed_one_found(tmp_path):
    FirstParameters(FOUND, PROCESSES, tmp_path).keep()
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == FOUND


def test_a_node_that_was_started_anew_has_new_parameters(tmp_path):
    FirstParameters(FOUND, PROCESSES, tmp_path).keep()
    anew = FirstParameters({**LEFT, "driver": {"watch.travel": 0.2}}, {**PROCESSES, "driver": "03"}, tmp_path)
    assert anew.values == {"driver": {"watch.travel": 0.2}, "logger": FOUND["logger"]}


def test_nodes_that_were_released_keep_what_they_are_given_later(tmp_path):
    first = FirstParameters(FOUND, PROCESSES, tmp_path)
    first.keep()
    first.forget()
    assert not list(tmp_path.iterdir())
    assert FirstParameters(LEFT, PROCESSES, tmp_path).values == LEFT


def test_a_file_of_nonsense_counts_for_nothing(tmp_path):
    FirstParameters(FOUND, PROCESSES, tmp_path).keep()
    for file in tmp_path.iterdir():
        file.write_text(json.dumps(FOUND)[:20])
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
            if self.act is told_to_end:
                told_to_end()
            self.released = True


def told_to_end():
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
    before, one = signal.getsignal(signal.SIGTERM), stands_for_graph(told_to_end)
    assert main(["frequency-response", "--graph", "running"]) == 143
    assert one.released and "terminated" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


def test_what_a_response_leaves_is_in_a_folder_named_after_its_plot(stands_for_graph, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = stands_for_graph(failed)
    assert main(["frequency-response", "--graph", "running", "-o", "loop.png"]) == 1
    # A measurement that fails leaves what was there before.
    assert one.folder == tmp_path / "loop_graph" / "unfinished" and one.released


def test_nodes_get_the_whole_path_of_a_folder(stands_for_graph, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = stands_for_graph(failed)
    assert main(["commission", "--graph", "running", "-o", "found", "--only", "connection"]) == 1
    assert one.folder == tmp_path / "found"
