"""`straightcomp …`: one module for each verb with its tools. Another package adds a verb by an entry point of the group
`straightcomp.verbs`, as setup.py has them.

A module has a docstring, which is its help, SUMMARY, one line of text, and PURPOSE, one of `main.PURPOSES`; both as
plain literals, since they are read without an import. It also has either ``add_arguments(parser)`` and
``run(options)``, which returns the exit code (None is 0), or TOOLS, its tools by name. What is slow to
import, or comes with an extra, is imported in ``run``.
"""

import argparse
import codecs
import os
import re
import sys
import unicodedata
import warnings
from collections.abc import Callable
from io import TextIOWrapper
from typing import Any, NamedTuple


class Tool(NamedTuple):
    """One tool of a verb; the docstring of ``run`` is its help."""

    SUMMARY: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int | None]


class CommandFailed(Exception):
    """The command cannot do what was asked; the message says why, and what would help."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP came; what ends the command does so as after Ctrl-C."""


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


def open_closed_streams() -> None:
    """Put the null device in the place of standard streams that were closed (``>&-``), for which Python has None."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def print_in_any_encoding() -> None:
    """From now on no text fails on standard output and error, whatever encoding they have."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="straightcomp")


_as_python = warnings.formatwarning


def warn_in_sentences() -> None:
    """From now on a warning for the user is one sentence, said once; one of a library has its place in the code."""
    said = set[str]()

    def formatted(message: Warning | str, category: type[Warning], *place: Any, **line: Any) -> str:
        if category is not UserWarning:
            return _as_python(message, category, *place, **line)
        new = {f"warning: {printable(str(message))}\n"} - said
        said.update(new)
        return "".join(new)

    warnings.formatwarning = formatted
