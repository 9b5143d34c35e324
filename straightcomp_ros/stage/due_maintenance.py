"""What maintenance is due by a file of advice, for the live view and the gateway, which look at it all the time."""

import json
from pathlib import Path

from straightcomp_ros.parameters.yaml_text import bounded_bytes


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


def due_maintenance(file: str) -> str:
    """What is due now by a file of advice, in one line; empty if nothing is, and for an empty name.

    A file that is not there yet says nothing: `straightcomp history advise` may run for the first time tonight. One
    that cannot be read says so in place of advice, since silence would look like a sound stage.
    """
    path = Path(file)
    try:
        return read_advice(path) if file and path.exists() else ""
    except (OSError, MaintenanceError) as error:
        return f"as of now: {error}"
