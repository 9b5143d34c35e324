"""Many trials at once: on the cores of this machine by joblib, or on those of others by Dask; the same numbers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence

from joblib import Parallel, delayed

from straightcomp_ros.offline.sweep.scenario import Scenario
from straightcomp_ros.offline.sweep.trial import TrialResult, laws_of, run_trial

_LARGEST_BATCH = 10
"""Trials sent to a worker at once: two seconds of work, so that progress is seen, and sending costs nothing."""
_CONNECT_S = 20.0

Progress = Callable[[float], None]


class SweepError(RuntimeError):
    """A sweep cannot be spread over workers; the message says why, and what would help."""


def run_trials(scenario: Scenario, seed: int, trials: Sequence[int]) -> list[TrialResult]:
    """The results of ``trials``, one after the other, for each law: what one worker does."""
    laws = laws_of(scenario)
    return [result for trial in trials for result in run_trial(scenario, laws, seed, trial)]


def sweep(
    scenario: Scenario,
    seed: int,
    trials: int,
    *,
    jobs: int = -1,
    dask: str = "",
    progress: Progress = lambda fraction: None,
) -> list[TrialResult]:
    """Run trials 0 to ``trials`` − 1, in whatever order; the results are sorted by trial, then as the laws stand.

    Args:
        scenario: what the trials have in common.
        seed: of all random numbers.
        trials: how many.
        jobs: processes on this machine; −1 takes all cores. Not used with ``dask``.
        dask: address of a Dask scheduler, whose workers have this package; empty stays on this machine.
        progress: called with the fraction that is done.

    Raises:
        SweepError: Dask is not installed, or its scheduler or workers cannot be reached.
    """
    workers = jobs if jobs > 0 else os.cpu_count() or 1
    batches = _batches(trials, workers)
    finished = _on_dask(dask, scenario, seed, batches) if dask else _on_this_machine(jobs, scenario, seed, batches)
    results: list[TrialResult] = []
    progress(0.0)
    for batch in finished:
        results += batch
        progress(len(results) / (trials * len(scenario.controls)))
    order = {law: place for place, law in enumerate(scenario.controls)}
    return sorted(results, key=lambda result: (result.trial, order[result.law]))


def _batches(trials: int, workers: int) -> list[range]:
    """Pieces of ``range(trials)``, at least one for each worker as long as there are trials."""
    size = max(1, min(_LARGEST_BATCH, trials // workers))
    return [range(start, min(start + size, trials)) for start in range(0, trials, size)]


def _on_this_machine(jobs: int, scenario: Scenario, seed: int, batches: Sequence[range]) -> Iterator[list[TrialResult]]:
    parallel = Parallel(n_jobs=jobs, backend="loky", return_as="generator_unordered")
    return iter(parallel(delayed(run_trials)(scenario, seed, batch) for batch in batches))


def _on_dask(address: str, scenario: Scenario, seed: int, batches: Sequence[range]) -> Iterator[list[TrialResult]]:
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise SweepError("Dask is not installed. Remedy: pip install 'straightcomp_ros[dask]'") from error
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SweepError(f"no Dask scheduler at {address!r}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError as error:
            raise SweepError(
                f"the Dask scheduler at {address!r} has no worker. Remedy: dask worker {address}"
            ) from error
        # Sent once to each worker, not with each batch.
        everywhere = client.scatter(scenario, broadcast=True, hash=False)
        futures = [client.submit(run_trials, everywhere, seed, batch, pure=False) for batch in batches]
        try:
            for _, results in as_completed(futures, loop=client.loop, with_results=True):
                yield results
        finally:
            client.cancel(futures)
