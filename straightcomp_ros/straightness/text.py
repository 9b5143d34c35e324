"""The text files of a survey: lines, cells and numbers, with errors that name the file, the line and the value."""

import codecs
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path


class SurveyError(ValueError):
    """A survey cannot be used; the message names the file, the line or the position, the value and what is allowed."""


def numbered_lines(
    path: Path, comment: str = "(?!)", encodings: Sequence[str] = ("utf-8",)
) -> Iterator[tuple[int, str]]:
    """Number and text of the lines of a text file without comments, which the pattern ``comment`` matches, and without
    the lines that are then blank. The first of the ``encodings`` that fits is taken, or what a byte order mark says.

    Raises:
        SurveyError: the file cannot be read, or has none of the encodings.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SurveyError(f"survey {path}: cannot be read: {error.strerror}") from error
    # Spreadsheets put a byte order mark in front.
    marked = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
    encodings = [name for mark, name in marked.items() if content.startswith(mark)] or encodings
    for encoding in encodings:
        try:
            text = content.decode(encoding)
            break
        except UnicodeDecodeError as error:
            failed = error
    else:
        raise SurveyError(f"survey {path}: byte {failed.start} is not UTF-8; save the file as UTF-8 text") from failed
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
