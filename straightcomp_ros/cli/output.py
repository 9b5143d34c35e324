"""What all verbs share on the terminal: errors, progress, warnings, JSON."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console

from straightcomp_ros.settings.plain_json import plain

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


class Terminated(KeyboardInterrupt):
    """SIGTERM came; what ends the command does so as after Ctrl-C."""


def require_ros() -> None:
    """Raise CommandFailed with exit code 2 where rclpy is missing."""
    from straightcomp_ros.cell.launcher import ros_available

    if not ros_available():
        remedy = "source a ROS 2 Jazzy installation, or: pip install 'straightcomp_ros[ros]'"
        raise CommandFailed(f"rclpy is not there; {remedy}", exit_code=2)


def progress_bar() -> Progress:
    """A progress bar on standard error; none where that is no terminal."""
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
def working(description: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar; yields what sets the fraction that is done. Before its first call the bar only moves."""
    with progress_bar() as bar:
        task = bar.add_task(description, total=None)
        yield lambda fraction: bar.update(task, completed=fraction, total=1.0)


@contextmanager
def noted_warnings(category: type[Warning] = Warning) -> Iterator[list[str]]:
    """Print each different warning of a category once on standard error; at its end the list holds their texts."""
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield texts
    texts += dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, category))
    for text in texts:
        notes.print(f"warning: {text}", style="yellow", soft_wrap=True)


def print_json(values: Mapping[str, Any]) -> None:
    """Print one JSON object; a number that is not finite becomes null, as JSON has no word for it."""
    print(json.dumps(plain(values)))
