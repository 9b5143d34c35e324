"""For all tests."""

import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from verbs import Ended, exit_code

from straightcomp_ros.cell.launcher import Graph

pytest_plugins = ["repeats", "firmware_programs", "dask_scheduler"]

HERE = Path(__file__).parent
NIGHTLY = {HERE / name for name in ("kernel", "trials")}

# In the background of a script SIGINT is ignored, and the programs that tests start and interrupt would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A machine that others use too stands still for half a second now and then: an example is not wrong for being late.
settings.register_profile("shared machine", deadline=None)
settings.load_profile("shared machine")


def pytest_addoption(parser):
    parser.addoption(
        "--trigger",
        choices=("sample", "timer"),
        default="sample",
        help="what begins the controller's cycles in live tests",
    )


@pytest.hookimpl(hookwrapper=True, trylast=True)
def pytest_runtest_call(item):
    """In a worker of xdist coverage runs twice: as in any subprocess, and by pytest-cov. Where pytest-cov pauses for
    the mark ``no_cover``, the other one would go on, and the test take three times as long."""
    coverage = sys.modules.get("coverage")
    paused = []
    if coverage is not None and item.get_closest_marker("no_cover"):
        while (running := coverage.Coverage.current()) is not None:
            running.stop()
            paused.append(running)
    yield
    for one in reversed(paused):
        one.start()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    for item in items:
        if NIGHTLY & set(item.path.parents):
            item.add_marker(pytest.mark.nightly)
        # `make test` looks for live tests in few folders: to import all the others takes a quarter of a minute.
        if item.get_closest_marker("live") and not {*NIGHTLY, HERE / "nodes"} & set(item.path.parents):
            raise pytest.UsageError(f"{item.nodeid}: tests with the mark 'live' belong in test/nodes, kernel or trials")


@pytest.fixture(autouse=True)
def only_live_tests_start_nodes(request, monkeypatch):
    """A test without the mark ``live`` runs beside others and is not repeated: nothing in it must be in time."""
    unhurried = {"single", "in_lockstep"} & set(request.fixturenames)
    if request.node.get_closest_marker("live") is None and not unhurried:

        def refuse(self, name, *_, **__):
            raise AssertionError(f"this test starts the node '{name}': it needs the mark 'live'")

        monkeypatch.setattr(Graph, "start", refuse)


@pytest.fixture
def verb(capsys):
    """``verb("evaluate", bag, "--json")`` runs `straightcomp evaluate BAG --json` in this process."""

    def run(*words: Any) -> Ended:
        capsys.readouterr()
        return Ended(exit_code(words), *capsys.readouterr())

    return run
