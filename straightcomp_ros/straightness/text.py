"""Reading the text files of a survey, with errors that name the file, the line and the value."""

from __future__ import annotations

import math
from pathlib import Path

from straightcomp_ros.straightness.survey_columns import SurveyError


def read_text(path: Path) -> str:
    """The whole file, UTF-8 with or without byte order mark.

    Raises:
        SurveyError: the file cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark in front
    except OSError as error:
        raise SurveyError(f"survey {path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyError(f"survey {path}: byte {error.start} is not UTF-8; save the file as UTF-8 text") from error


def number(where: str, name: str, cell: str) -> float:
    """``cell`` as a finite number; ``where`` opens the message, ``name`` says what the cell is.

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
    """Fixed point without trailing zeros: ``10``, ``-0.482``; never ``-0``."""
    text = f"{value:.{places}f}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
