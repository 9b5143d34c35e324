"""The verbs that measure a graph release it when they are told to end, and keep to a folder of their own."""

import os
import signal
from contextlib import contextmanager

import pytest

from straightcomp_ros.cli.main import main
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.tuning.commissioning import CommissioningError
from straightcomp_ros.tuning.graph import machine_access
from straightcomp_ros.tuning.graph.machine_access import Access


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
