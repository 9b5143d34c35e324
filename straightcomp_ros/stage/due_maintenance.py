"""What maintenance is due by a file of advice, for the live view and the gateway, which look at it all the time."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path

from straightcomp_ros.parameters.yaml_text import bounded_bytes

_LOOK_EVERY_S = 1.0


class MaintenanceError(ValueError):
    """A stage's history, or a file of advice, does not serve; the text says why, and what is needed."""


def read_advice(path: Path) -> str:
    """What is due by a file of advice and as of which day, in one line; empty if nothing is. MaintenanceError, which
    names the file, if it cannot be read or is none."""
    try:
        tree = json.loads(bounded_bytes(path, 1))
        sentences = [f"{one['text']}; {one['remedy']}" for one in tree["advice"]]
        _, day = tree["stage"], tree["as_of"]  # both must be there
        return f"as of {day}: {' | '.join(sentences)}" if sentences else ""
    except OSError as error:
        raise MaintenanceError(f"maintenance file {path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
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
        self._due = ""

    def due(self) -> str:
        """What is due in one line, empty if nothing is; by a look at the file at most once a second."""
        now = self._clock()
        if self._path is not None and now >= self._next_look:
            self._next_look = now + _LOOK_EVERY_S
            try:
                self._due = read_advice(self._path) if self._path.exists() else ""
            except (OSError, MaintenanceError) as error:
                self._due = f"as of now: {error}"
        return self._due
