"""What all verbs share on the terminal: errors, progress, warnings, JSON."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
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


def require_ros() -> None:
    """Raise CommandFailed with exit code 2 where rclpy is missing."""
    from straightcomp_ros.cell.launcher import ros_available

    if not ros_available():
        remedy = "source a ROS 2 Jazzy installation, or: pip install 'straightcomp_ros[ros]'"
        raise CommandFailed(f"rclpy is not there; {remedy}", exit_code=2)


def check_range(option: str, value: float, least: float, most: float = math.inf, unit: str = "") -> None:
    """Raise CommandFailed with exit code 2 if an option's value is outside ``least`` to ``most``, or NaN."""
    if not least <= value <= most:
        allowed = f">= {least:.4g}" if most == math.inf else f"{least:.4g} to {most:.7g}"
        raise CommandFailed(f"{option} {value:g}; allowed: {allowed}{unit and ' '}{unit}", exit_code=2)


def add_repeatable(parser: argparse.ArgumentParser, option: str, metavar: str | None, text: str, **more: Any) -> None:
    """Declare an option that may be given several times; its values are a list."""
    more = {"action": "append", "default": [], **more}
    parser.add_argument(option, metavar=metavar, help=f"{text}; may be repeated", **more)


PICTURES = (".png", ".svg", ".pdf")
"""Endings of the files that plots are saved to."""


def output_file(option: str, name: str, endings: tuple[str, ...] = ()) -> Path:
    """The file that an option names, checked before the work whose result it gets.

    Raises:
        CommandFailed: it cannot be written, or has another ending than ``endings``; exit code 2.
    """
    path = Path(name)
    if endings and path.suffix.lower() not in endings:
        raise CommandFailed(f"{option} {name}; allowed: a file name that ends with {', '.join(endings)}", exit_code=2)
    if path.is_dir():
        raise CommandFailed(f"{option} {name}: is a folder; name a file", exit_code=2)
    if not path.parent.is_dir():
        raise CommandFailed(f"{option} {name}: there is no folder {path.parent}; make it first", exit_code=2)
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise CommandFailed(f"{option} {name}: cannot be written; check its permissions", exit_code=2)
    return path


def output_folder(option: str, name: str) -> Path:
    """The folder that an option names, made if need be; CommandFailed with exit code 2 if it cannot be made."""
    path = Path(name)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "is a file" if path.exists() else f"cannot be made: {error.strerror}"
        raise CommandFailed(f"{option} {name}: {why}; name another folder", exit_code=2) from error
    return path


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
