"""However the trials are spread, the numbers are the same."""

import importlib.util
import sys

import pytest

from straightcomp_ros.offline.workers import WorkersError
from straightcomp_ros.tuning.sweep.many_trials import run_trials, sweep

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


@needs_dask
def test_dask_workers_give_what_this_machine_gives_to_the_last_bit(scenario, scheduler):
    assert sweep(scenario, 9, range(TRIALS), dask=scheduler) == sweep(scenario, 9, range(TRIALS), jobs=2)


@needs_dask
@pytest.mark.parametrize("address", ["127.0.0.1:9", "nowhere://1"])
def test_a_scheduler_that_is_not_there_is_named(scenario, monkeypatch, address):
    monkeypatch.setattr("straightcomp_ros.offline.workers._CONNECT_S", 1.0)
    with pytest.raises(WorkersError, match=address):
        sweep(scenario, 9, range(1), dask=address)


def test_without_dask_the_remedy_is_named(scenario, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(WorkersError, match="pip install"):
        sweep(scenario, 9, range(1), dask="127.0.0.1:8786")
