"""A Dask scheduler with workers for tests."""

import pytest


@pytest.fixture
def scheduler(monkeypatch):
    """Address of a Dask scheduler with two workers, each in a process of its own."""
    from distributed import LocalCluster

    # Workers that are traced take 20 s to end.
    monkeypatch.delenv("COVERAGE_PROCESS_CONFIG", raising=False)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address
