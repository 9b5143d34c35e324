"""The text files of a survey: lines, cells and numbers, with errors that name the file, the line and the value."""

import math
import re
from collections.abc import Iterator
from pathlib import Path


class SurveyError(ValueError):
    """A survey cannot be used; the message names the file, the line or the position, the value and what is allowed."""


def numbered_lines(path: Path, comment: str = "(?!)") -> Iterator[tuple[int, str]]:
    """Number and text of the lines of a UTF-8 file without comments, which the pattern ``comment`` matches, and without
    the lines that are then blank.

    Raises:
        SurveyError: the file cannot be read, or is not UTF-8.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark in front
    except OSError as error:
        raise SurveyError(f"survey {path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyError(f"survey {path}: byte {error.start} is not UTF-8; save the file as UTF-8 text") from error
    for number, raw in enumerate(text.splitlines(), start=1):
        line = re.sub(comment, "", raw)
        if line.strip():
            yield number, line


def number(where: str, name: str, cell: str) -> float:
    """``cell`` as a finite number; ``where`` begins the message, ``name`` says what the cell is.

    Raises:
        SurveyError: it is none.
    """
    try:
        value = float(cell)
    except ValueError:
        raise SurveyError(f"{where}: {name} {cell!r}; allowed: a number") from None
    if not math.isfinite(value):
        raise SurveyError(f"{where}: {name} {cell!r}; allowed: a finite number")
    return value


def decimal(value: float, places: int) -> str:
    """Fixed point, ``places`` > 0, without trailing zeros: ``10``, ``-0.482``; never ``-0``."""
    text = f"{value:.{places}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
