"""Bags in folders that grow: each is given out once when it is whole.

Folders are listed again and again, since network file systems and S3 tell nobody of changes.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

from straightcomp_ros.fleet.history.bag_places import BagPlace, is_finished
from straightcomp_ros.fleet.history.bag_row import BagRow

SETTLED_S = 60.0
"""Time in s without a change after which an unfinished bag counts as cut off."""


class GrowingFolders:
    """Remembers which bags it gave out: 0.1 kB for each."""

    def __init__(self, settled_s: float = SETTLED_S) -> None:
        self._settled_s = settled_s
        self._given: set[int] = set()
        self._waiting: dict[str, tuple[int, float]] = {}

    def whole(self, places: Iterable[BagPlace]) -> Iterator[BagPlace]:
        """Of the bags that are there now those that were not given out as they are: finished ones, and those that have
        not changed since an earlier call, ``settled_s`` ago."""
        for place in places:
            state = _state(place)
            if state in self._given:
                continue
            if not _finished(place) and not self._settled(place.location, state):
                continue
            self._waiting.pop(place.location, None)
            self._given.add(state)
            yield place

    def retry(self, row: BagRow) -> None:
        """Give the bag of a row out again, if it is there."""
        self._given.discard(_state(row))

    def _settled(self, location: str, state: int) -> bool:
        now = time.monotonic()
        known, since = self._waiting.get(location, (state, now))
        self._waiting[location] = (state, since if known == state else now)
        return known == state and now - since >= self._settled_s


def _finished(place: BagPlace) -> bool:
    try:
        return is_finished(place)
    except OSError:
        return False  # it has gone meanwhile, or cannot be read now


def _state(place: BagPlace | BagRow) -> int:
    return hash((place.location, place.size, place.modified))
