"""The lines of a CSV file as cells, and a cell as a length."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from straightcomp_ros.straightness import text
from straightcomp_ros.straightness.survey_columns import Column


def rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of all lines that are neither blank nor comment.

    Raises:
        SurveyError: the file cannot be read, or is not UTF-8.
    """
    delimiter = ""
    for line_number, line in enumerate(text.read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if not delimiter:
            delimiter = next((mark for mark in "\t;" if mark in line), ",")
        cells = next(csv.reader([line], delimiter=delimiter))
        # Where the comma does not separate cells it is a decimal point, as spreadsheets of many countries write it.
        yield line_number, cells if delimiter == "," else [cell.replace(",", ".") for cell in cells]


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
    return text.number(f"survey {path}, line {line}", name, cell.strip())
