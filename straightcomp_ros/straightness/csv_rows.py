"""The lines of a CSV file as cells, and a cell as a length."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from straightcomp_ros.straightness.columns import Column, SurveyError


def rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of all lines that are neither blank nor comment.

    Raises:
        SurveyError: the file cannot be read, or is not UTF-8.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark in front
    except OSError as error:
        raise SurveyError(f"survey {path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyError(f"survey {path}: byte {error.start} is not UTF-8; save the file as UTF-8 CSV") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, next(csv.reader([line]))


def metres(path: Path, line: int, row: Sequence[str], column: Column) -> float:
    """The cell of ``column`` in m.

    Raises:
        SurveyError: it is no finite number.
    """
    return column.metres(number(path, line, row[column.index], f"{column.quantity.name}_{column.unit}"))


def number(path: Path, line: int, cell: str, name: str) -> float:
    """The number in a cell of the column ``name``.

    Raises:
        SurveyError: it is no finite number.
    """
    cell = cell.strip()
    try:
        value = float(cell)
    except ValueError:
        raise SurveyError(f"survey {path}, line {line}: {name} {cell!r}; allowed: a number") from None
    if not math.isfinite(value):
        raise SurveyError(f"survey {path}, line {line}: {name} {cell!r}; allowed: a finite number")
    return value
