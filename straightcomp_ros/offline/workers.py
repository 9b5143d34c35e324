"""Spreads work over the cores of this machine by joblib, or over those of others by Dask."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

from joblib import Parallel, delayed

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_CONNECT_S = 20.0
_AHEAD = 4
"""Items that wait for each core of a Dask cluster: enough to keep it busy, and few enough to fit into any memory."""


class WorkersError(RuntimeError):
    """Work cannot be spread over workers; the message says why, and what would help."""


def spread(
    function: Callable[..., _Result],
    shared: tuple[Any, ...],
    items: Iterable[_Item],
    *,
    jobs: int = -1,
    dask: str = "",
) -> Iterator[_Result]:
    """``function(*shared, item)`` of each item, in the order in which they come back. The items are fetched as workers
    become free, so that there may be any number of them.

    Args:
        function: of a module that the workers can import.
        shared: what all calls have in common; sent to each worker once.
        items: what they do not.
        jobs: processes on this machine; −1 takes all cores. Not used with ``dask``.
        dask: address of a Dask scheduler, whose workers have this package; empty stays on this machine.

    Raises:
        WorkersError: Dask is not installed, or its scheduler or workers cannot be reached.
    """
    return _on_dask(dask, function, shared, items) if dask else _on_this_machine(jobs, function, shared, items)


def _on_this_machine(
    jobs: int, function: Callable[..., _Result], shared: tuple[Any, ...], items: Iterable[_Item]
) -> Iterator[_Result]:
    parallel = Parallel(n_jobs=jobs, backend="loky", return_as="generator_unordered")
    results = parallel(delayed(function)(*shared, item) for item in items)
    try:
        for result in results:  # noqa: UP028 - `yield from` would close it before the warning is switched off
            yield result
    finally:
        with warnings.catch_warnings():
            # joblib warns of results that nobody took: after Ctrl-C or an error nobody wants them.
            warnings.simplefilter("ignore")
            results.close()


def _on_dask(
    address: str, function: Callable[..., _Result], shared: tuple[Any, ...], items: Iterable[_Item]
) -> Iterator[_Result]:
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise WorkersError("Dask is not installed. Remedy: pip install 'straightcomp_ros[dask]'") from error
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkersError(f"no Dask scheduler at {address!r}: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError as error:
            raise WorkersError(
                f"the Dask scheduler at {address!r} has no worker. Remedy: dask worker {address}"
            ) from error
        # Sent once to each worker, not with each item.
        everywhere = client.scatter(list(shared), broadcast=True, hash=False) if shared else []
        remaining, pending = iter(items), set[Any]()

        def submitted(count: int) -> list[Any]:
            futures = [client.submit(function, *everywhere, item, pure=False) for item in islice(remaining, count)]
            pending.update(futures)
            return futures

        completed = as_completed(submitted(_AHEAD * sum(client.nthreads().values())), loop=client.loop)
        try:
            for future in completed:
                pending.remove(future)
                completed.update(submitted(1))
                yield future.result()
        finally:
            client.cancel(list(pending))
