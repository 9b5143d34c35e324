"""What all verbs share on the terminal: errors, progress, JSON."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console

if TYPE_CHECKING:
    from rich.progress import Progress

console = Console()
"""Standard output: results."""
notes = Console(stderr=True)
"""Standard error: progress and remarks, so that results can be piped."""


class CommandFailed(Exception):
    """The command cannot do what was asked; the message says why, and what would help."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def require_ros() -> None:
    """Refuse to go on where rclpy is not there.

    Raises:
        CommandFailed: so it is.
    """
    from straightcomp_ros.launcher import ros_available

    if not ros_available():
        raise CommandFailed(
            "rclpy is not there; source a ROS 2 Jazzy installation, or: pip install 'straightcomp_ros[ros]'",
            exit_code=2,
        )


def progress_bar() -> Progress:
    """A progress bar on standard error, silent when that is no terminal."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        console=notes,
        disable=not sys.stderr.isatty(),
        transient=True,
    )


@contextmanager
def working(description: str) -> Iterator[None]:
    """The same for work of unknown length: the bar only moves."""
    with progress_bar() as bar:
        bar.add_task(description, total=None)
        yield


def print_json(values: Mapping[str, Any]) -> None:
    """One JSON object on standard output; what is not finite becomes null, which JSON can say."""
    print(json.dumps(_plain(values)))


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
