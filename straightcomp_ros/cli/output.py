"""What all verbs share on the terminal: errors, progress, warnings, JSON."""

from __future__ import annotations

import codecs
import json
import re
import sys
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import TextIOWrapper
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from straightcomp_ros.parameters.plain_json import plain

if TYPE_CHECKING:
    from rich.progress import Progress

_ASCII = str.maketrans({"µ": "u", "–": "-", "−": "-", "±": "+-", "→": "->", "≥": ">=", "≤": "<=", "…": "...", "×": "x"})
# All but the tab and the end of a line, which tables and texts of several lines need; and what reverses a line's order.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """The text with its control characters, which would steer the terminal, as escapes such as ``\\x1b``."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    """An error handler of codecs: what the terminal cannot show in similar characters, or as an escape."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    known = unicodedata.normalize("NFKD", text.translate(_ASCII)).encode("ascii", "ignore").decode()
    return known or text.encode("ascii", "backslashreplace").decode(), error.end


codecs.register_error("straightcomp", _in_ascii)


def print_in_any_encoding() -> None:
    """From now on no text fails on standard output and error, whatever encoding they have."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="straightcomp")


class _Console(Console):
    """Prints texts as they are: names of users are never markup, nor control the terminal. Styles come as ``style`` or
    as rich's Text, made by :func:`styled`."""

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:  # type: ignore[override]
        return super().render_str(printable(text), **options)


def styled(*parts: str | tuple[str, str]) -> Text:
    """One line of texts, and of texts with their styles."""
    return Text.assemble(*(printable(one) if isinstance(one, str) else (printable(one[0]), one[1]) for one in parts))


console = _Console()
"""Standard output: results."""
notes = _Console(stderr=True)
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
        TextColumn("{task.description}", markup=False),
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
