"""The threads of this process, the middleware's too, as Linux lists them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

_TASKS = Path("/proc/self/task")


def threads() -> dict[int, str]:
    """Id and name of each thread.

    Raises:
        OSError: the system does not list them.
    """
    names = {}
    for task in _TASKS.iterdir():
        # A thread may end meanwhile.
        with suppress(OSError):
            names[int(task.name)] = (task / "comm").read_text().strip()
    return names
