"""What all verbs share on the terminal: errors, progress, warnings, JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from straightcomp_ros.cli import CommandFailed, Terminated, printable
from straightcomp_ros.parameters.output_files import plain

__all__ = ["CommandFailed", "Terminated", "printable"]

if TYPE_CHECKING:
    from rich.progress import Progress


class _Console(Console):
    """Prints texts as they are: names of users are never markup, nor control the terminal. Styles come as ``style`` or
    as rich's Text, made by :func:`styled`."""

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False)
        if not self.width:  # COLUMNS=0 means unknown, as for argparse; rich would print nothing
            self.width = 80

    def print(self, *objects: Any, **options: Any) -> None:  # type: ignore[override]
        """As of rich; a sentence is one line, so that it can be copied, and its numbers have no colour."""
        if all(isinstance(one, str | Text) for one in objects):
            options = {"soft_wrap": True, "highlight": False, **options}
        super().print(*objects, **options)

    def on_broken_pipe(self) -> None:
        """Leave it to `main`, as for what is not printed by rich, which would end with exit code 1."""
        raise

    def render_str(self, text: str, **options: Any) -> Text:  # type: ignore[override]
        return super().render_str(printable(text), **options)


def styled(*parts: str | tuple[str, str]) -> Text:
    """One line of texts, and of texts with their styles."""
    return Text.assemble(*(printable(one) if isinstance(one, str) else (printable(one[0]), one[1]) for one in parts))


console = _Console()
"""Standard output: results."""
notes = _Console(stderr=True)
"""Standard error: progress and remarks, so that results can be piped."""


def require_ros() -> None:
    """Raise CommandFailed with exit code 2 where rclpy is missing."""
    from straightcomp_ros.cell.launcher import ROS_REMEDY, ros_available

    if not ros_available():
        raise CommandFailed(f"rclpy is not there; {ROS_REMEDY}", exit_code=2)


def progress_bar() -> Progress:
    """A progress bar on standard error; none where that is no terminal."""
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
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


def print_warnings(texts: Iterable[str]) -> None:
    """Print these sentences as warnings on standard error."""
    for text in texts:
        notes.print(f"warning: {text}", style="yellow")


def print_written(*files: object, then: str) -> None:
    """End of a verb that has written something: what, and what to do next, a command or a sentence."""
    notes.print(f"written: {', '.join(map(str, files))}\nnext: {then}")


def print_json(values: Mapping[str, Any], default: Callable[[Any], Any] | None = None) -> None:
    """Print one JSON object; a number that is not finite becomes null, as JSON has no word for it, and what else it has
    no word for ``default`` of that."""
    print(json.dumps(plain(values), default=default))
