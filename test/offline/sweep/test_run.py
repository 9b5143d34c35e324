"""However the trials are spread, the numbers are the same."""

import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from straightcomp_ros.offline.sweep.many_trials import SweepError, run_trials, sweep

REPOSITORY = Path(__file__).resolve().parents[3]
START_S = 60.0
TRIALS = 5

needs_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None,
    reason="NOT TESTED: sweeps on Dask. Remedy: pip install -e '.[test]'",
)


def test_two_processes_give_what_one_gives(scenario):
    fractions = []
    results = sweep(scenario, 9, range(TRIALS), jobs=2, progress=fractions.append)
    assert results == run_trials(scenario, 9, range(TRIALS))
    assert fractions[0] == 0.0 and fractions[-1] == 1.0 and fractions == sorted(fractions)


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """Address of a Dask scheduler with two workers, each in a process of its own."""
    file = tmp_path / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])}

    def start(*arguments: str) -> subprocess.Popen:
        log = (tmp_path / f"{arguments[0]}.log").open("a")
        command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard", "--scheduler-file", str(file)]
        return subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=log, stderr=subprocess.STDOUT)

    processes = [start("scheduler", "--host", "127.0.0.1", "--port", "0")]
    try:
        deadline = time.monotonic() + START_S
        while not (file.is_file() and file.read_text().strip()):
            assert processes[0].poll() is None and time.monotonic() < deadline, (tmp_path / "scheduler.log").read_text()
            time.sleep(0.1)
        processes += [start("worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny") for _ in range(2)]
        yield json.loads(file.read_text())["address"]
    finally:
        # Killed: two of them that were asked to end under coverage were still there after 20 s each.
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


@needs_dask
def test_dask_workers_give_what_this_machine_gives_to_the_last_bit(scenario, scheduler):
    from distributed import Client

    with Client(scheduler, timeout=START_S, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=START_S)
    assert sweep(scenario, 9, range(TRIALS), dask=scheduler) == sweep(scenario, 9, range(TRIALS), jobs=2)


@needs_dask
@pytest.mark.parametrize("address", ["127.0.0.1:9", "nowhere://1"])
def test_a_scheduler_that_is_not_there_is_named(scenario, monkeypatch, address):
    monkeypatch.setattr("straightcomp_ros.offline.sweep.many_trials._CONNECT_S", 1.0)
    with pytest.raises(SweepError, match=address):
        sweep(scenario, 9, range(1), dask=address)


def test_without_dask_the_remedy_is_named(scenario, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SweepError, match="pip install"):
        sweep(scenario, 9, range(1), dask="127.0.0.1:8786")
