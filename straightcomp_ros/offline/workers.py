"""Spreads work over the cores of this machine, or over those of a Dask cluster, by joblib."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import Any, TypeVar

from joblib import Parallel, delayed, parallel_config

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_CONNECT_S = 20.0


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
    with ExitStack() as open_client:
        if dask:
            client = open_client.enter_context(_client_of(dask))
            where = {"backend": "dask", "client": client, "scatter": list(shared)}
        else:
            where = {"backend": "loky", "n_jobs": jobs}
        with parallel_config(**where):
            parallel = Parallel(return_as="generator_unordered")
        results = parallel(delayed(function)(*shared, item) for item in items)
        try:
            for result in results:  # noqa: UP028 - `yield from` would close it before the warning is switched off
                yield result
        finally:
            with warnings.catch_warnings():
                # joblib warns of results that were not taken: after Ctrl-C or an error none are wanted.
                warnings.simplefilter("ignore")
                results.close()


def _client_of(address: str) -> Any:
    """A client of a Dask scheduler with a worker."""
    try:
        from distributed import Client
    except ImportError as error:
        raise WorkersError("Dask is not installed. Remedy: pip install 'straightcomp_ros[dask]'") from error
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkersError(f"no Dask scheduler at {address!r}: {error}") from error
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError as error:
        client.close()
        raise WorkersError(f"the Dask scheduler at {address!r} has no worker. Remedy: dask worker {address}") from error
    return client
