"""What maintenance is due by a file of advice, for the live view and the gateway, which look at it all the time."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

_LARGEST = 1_000_000
"""Bytes of a file that are read."""
_LOOK_EVERY_S = 1.0


class MaintenanceError(ValueError):
    """A stage's history, or a file of advice, does not serve; the text says why, and what is needed."""


@dataclass(frozen=True)
class DueMaintenance:
    """What a file says: a sentence for each matter, as of a day."""

    stage: str = ""
    as_of: str = ""
    sentences: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """All in one line; empty if nothing is due."""
        return f"as of {self.as_of}: {' | '.join(self.sentences)}" if self.sentences else ""


def read_advice(path: Path) -> DueMaintenance:
    """Read a file of advice; MaintenanceError, which names the file, if it cannot be read or is none."""
    try:
        with path.open("rb") as file:
            tree = json.loads(file.read(_LARGEST))
        sentences = tuple(f"{one['text']}; {one['remedy']}" for one in tree["advice"])
        return DueMaintenance(str(tree["stage"]), str(tree["as_of"]), sentences)
    except OSError as error:
        raise MaintenanceError(f"maintenance file {path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        why = f"is no file of advice ({type(error).__name__}: {error}); write it by `straightcomp history advise`"
        raise MaintenanceError(f"maintenance file {path}: {why}") from error


class WatchedAdvice:
    """The present content of a file; an empty name is no file.

    A file that is not there yet says nothing: `straightcomp history advise` may run for the first time tonight. One
    that cannot be read says so in place of advice, since silence would look like a sound stage. ``clock`` is monotonic,
    in s.
    """

    def __init__(self, file: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock = Path(file) if file else None, clock
        self._next_look = -math.inf
        self._due = DueMaintenance()

    def due(self) -> DueMaintenance:
        """What is due, by a look at the file at most once a second."""
        now = self._clock()
        if self._path is not None and now >= self._next_look:
            self._next_look = now + _LOOK_EVERY_S
            try:
                self._due = read_advice(self._path) if self._path.exists() else DueMaintenance()
            except (OSError, MaintenanceError) as error:
                self._due = DueMaintenance(as_of="now", sentences=(str(error),))
        return self._due
