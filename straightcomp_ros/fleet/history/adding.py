"""Adds bags to a store, on as many cores as wanted."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice

from straightcomp_ros.fleet.history.bag_places import BagPlace
from straightcomp_ros.fleet.history.bag_row import BagRow
from straightcomp_ros.fleet.history.evaluated_bag import evaluated
from straightcomp_ros.fleet.history.store import Store
from straightcomp_ros.offline.workers import spread


@dataclass
class Tally:
    """How many bags were added, were known and unchanged, or were refused, and how many strokes were added."""

    added: int = 0
    known: int = 0
    refused: int = 0
    strokes: int = 0


def add(
    store: Store,
    places: Iterable[BagPlace],
    tally: Tally,
    *,
    again: bool = False,
    jobs: int = -1,
    dask: str = "",
    remap: Mapping[str, str] | None = None,
    told: Callable[[BagRow], None] = lambda row: None,
) -> None:
    """Evaluate the bags that the store does not have as they are now, and write what they give, each as soon as it is
    there. Only this process writes: the workers need the bags, not the store.

    Args:
        store: the store.
        places: of the bags, any number.
        tally: is counted up.
        again: evaluates the bags that the store has, too.
        jobs, dask: where to evaluate, see :func:`straightcomp_ros.offline.workers.spread`.
        remap: the bags' topic for each of our topics that has another name there.
        told: called with each bag that was evaluated, after it was written.

    Raises:
        WorkersError: the workers cannot be reached.
        OSError: the store cannot be written, or a folder not be listed.
    """
    store.clear_abandoned()
    new = _new(store, places, tally, again)
    first = list(islice(new, 2))
    if not first:
        return
    # Other processes take longer to start than one bag takes.
    for bag in spread(
        partial(evaluated, remap=remap), (), chain(first, new), jobs=jobs if len(first) > 1 else 1, dask=dask
    ):
        with _whole():
            store.put(bag)
            if bag.row.reason is None:
                tally.added += 1
                tally.strokes += bag.row.strokes
            else:
                tally.refused += 1
        told(bag.row)


@contextmanager
def _whole() -> Iterator[None]:
    """Delays Ctrl-C until the end of the block: what was stored is also counted."""
    interrupts: list[int] = []
    former = signal.signal(signal.SIGINT, lambda number, frame: interrupts.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
    if interrupts:
        raise KeyboardInterrupt


def _new(store: Store, places: Iterable[BagPlace], tally: Tally, again: bool) -> Iterator[BagPlace]:
    for place in places:
        if not again and store.has(place):
            tally.known += 1
        else:
            yield place
