"""The columns of a survey: which lengths they hold, in which unit, and how large those of a guide are."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.straightness.text import SurveyError, number, numbered_lines


@dataclass(frozen=True)
class Quantity:
    """A length in a survey.

    Attributes:
        name: what the column's name begins with.
        per_metre: units that may follow the name, with how many of them make a metre.
        smallest, largest: allowed extent (largest minus smallest value) of a run in m. An extent outside of it is more
            likely a wrong unit than an odd machine.
    """

    name: str
    per_metre: Mapping[str, float]
    smallest: float
    largest: float

    @property
    def columns(self) -> dict[str, str]:
        """Unit of each name that a column of this quantity may have."""
        return {f"{self.name}_{unit}": unit for unit in self.per_metre}

    def check_extent(self, where: str, extent: float, unit: str = "m") -> None:
        """Refuse a run whose ``extent`` in m, given in ``unit``, is not that of a guide; ``where`` begins the message.

        Raises:
            SurveyError: with the unit that would fit, if one does.
        """
        if self.smallest <= extent <= self.largest:
            return
        fitting = [
            f"{self.name}_{other}"
            for other, per_metre in self.per_metre.items()
            if self.smallest <= extent * self.per_metre[unit] / per_metre <= self.largest
        ]
        hint = f"; is the unit wrong? It would fit as {' or '.join(fitting)}" if fitting else ""
        raise SurveyError(
            f"{where}: {self.name}_{unit} extends over {extent:.6g} m; "
            f"allowed: {self.smallest:g} m to {self.largest:g} m{hint}"
        )


X = Quantity("x", {"m": 1.0, "mm": 1e3, "um": 1e6}, smallest=0.01, largest=20.0)
DEVIATION = Quantity("deviation", {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9}, smallest=1e-8, largest=5e-3)


@dataclass(frozen=True)
class Column:
    """The column of ``quantity`` in ``unit``, and its index in a row."""

    quantity: Quantity
    unit: str
    index: int

    def metres(self, where: str, row: Sequence[str]) -> float:
        """The cell of ``row`` in m; ``where`` begins the message.

        Raises:
            SurveyError: the cell is no finite number.
        """
        value = number(where, f"{self.quantity.name}_{self.unit}", row[self.index].strip())
        return value / self.quantity.per_metre[self.unit]  # a decimal number stays the nearest float


class Table(NamedTuple):
    """A CSV file of a survey: normalised header, the columns of x and deviation, line number and cells of each row,
    numbers with decimal points."""

    header: list[str]
    x: Column
    deviation: Column
    rows: list[tuple[int, list[str]]]


_SYNONYMS = {"position": "x", "target": "x", "straightness": "deviation"}
"""What instruments call the two quantities."""
_NAME_AND_UNIT = re.compile(r"([a-z]+)[\s_]*[\[(]?\s*(m|mm|um|nm)\s*[\])]?")
_OWN_UNIT = re.compile(r".*?[^a-z](m|mm|um|nm)\s*[\])]?")
_DELIMITERS = "\t;,"
_SEPARATOR_LINE = re.compile(r"sep=(.)", re.IGNORECASE)
"""Excel's own first line, which names the delimiter."""
_LINES_BEFORE = 100
"""Lines in which the header is looked for: instruments write some tens of lines about the measurement before it."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""A number whose mark may separate thousands."""


def read_table(path: Path, names: Mapping[str, str] | None = None) -> Table:
    """Read the header and the rows of a CSV file.

    ``names`` has the file's own name, with its unit at the end, for the column of ``x`` or of ``deviation``.

    Raises:
        SurveyError: the file cannot be read or is empty, lacks a column or has it twice, has a row of another length,
            or numbers with points and commas in one another's place.
    """
    lines = list(numbered_lines(path, r"^\s*#.*"))
    if not lines:
        raise SurveyError(f"survey {path}: is empty; allowed: a header row, and a row for each point")
    own = {_plain(name): quantity for quantity, name in (names or {}).items()}
    start, delimiter = _header(lines, own)
    number_of_line, text = lines[start]
    header = _cells(text, delimiter, own)
    where = f"survey {path}, line {number_of_line}"
    try:
        x, deviation = (_find_column(where, header, name) for name in (X, DEVIATION))
    except SurveyError as error:
        # This module is part of what the formats are made of.
        from straightcomp_ros.straightness.tables.formats import recognised

        kind = recognised(path)
        if kind is None:
            raise
        raise SurveyError(
            f"survey {path}: is a file of another kind ({kind}); make a survey of it with "
            f"straightcomp map convert {path} --format {kind} -o survey.csv"
        ) from error
    rows = [(line, next(csv.reader([text], delimiter=delimiter))) for line, text in lines[start + 1 :]]
    for line, row in rows:
        if len(row) != len(header):
            raise SurveyError(
                f"survey {path}, line {line}: {len(row)} cells, the header has {len(header)} "
                "(is there a decimal comma?)"
            )
    numbers = [x.index, deviation.index, *(at for at, name in enumerate(header) if name == "time_s")]
    if delimiter != ",":
        _use_points(path, rows, numbers)
    return Table(header, x, deviation, rows)


def _header(lines: Sequence[tuple[int, str]], own: Mapping[str, str]) -> tuple[int, str]:
    """Index and delimiter of the first line with both columns; of the first line but Excel's own if none has them."""
    named = _SEPARATOR_LINE.fullmatch(lines[0][1].strip())
    first = 1 if named and len(lines) > 1 else 0
    delimiters = named[1] if named else _DELIMITERS
    for at in range(first, min(len(lines), _LINES_BEFORE)):
        for delimiter in delimiters:
            header = _cells(lines[at][1], delimiter, own)
            if all(any(name in header for name in quantity.columns) for quantity in (X, DEVIATION)):
                return at, delimiter
    return first, next((mark for mark in delimiters if mark in lines[first][1]), ",")


def _cells(text: str, delimiter: str, own: Mapping[str, str]) -> list[str]:
    """The cells of a header as they are compared; those that ``own`` names as the quantity's own column."""
    found = []
    for cell in next(csv.reader([text], delimiter=delimiter)):
        name = _plain(cell)
        unit = _OWN_UNIT.fullmatch(name)
        usual = _normalised(cell)
        if name in own:
            found.append(f"{own[name]}_{unit[1]}" if unit else name)
        else:
            # Where a column of this quantity is chosen by its own name, no other is meant.
            found.append(name if usual.partition("_")[0] in own.values() else usual)
    return found


def _use_points(path: Path, rows: Sequence[tuple[int, list[str]]], columns: Sequence[int]) -> None:
    """Make points of decimal commas, and leave the marks out that separate thousands."""
    cells = [row[column].strip() for _, row in rows for column in columns]
    decimal = {mark for mark in ".," if any(mark in cell and not _GROUPED.fullmatch(cell) for cell in cells)}
    both = [
        (line, row[column]) for line, row in rows for column in columns if "." in row[column] and "," in row[column]
    ]
    if both:
        decimal = {max(".,", key=cell.rfind) for _, cell in both}
    marks = {mark for mark in ".," if any(mark in cell for cell in cells)}
    if len(marks) == 2 and len(decimal) != 1:
        line = next(line for line, row in rows for column in columns if "," in row[column])
        raise SurveyError(
            f"survey {path}, line {line}: the numbers have points and commas, and either may be the decimal mark; "
            "allowed: one decimal mark, and thousands without any"
        )
    point = decimal.pop() if len(marks) == 2 else "".join(marks)
    for line, row in rows:
        for column in columns:
            cell = row[column].strip()
            whole, mark, fraction = cell.partition(point) if point else (cell, "", "")
            other = "," if point == "." else "."
            if other in cell and (other in fraction or not _GROUPED.fullmatch(whole)):
                raise SurveyError(
                    f"survey {path}, line {line}: {cell!r}; allowed: a number with {point!r} as the decimal mark, as "
                    "in other lines"
                )
            row[column] = whole.replace(other, "") + ("." + fraction if mark else "")


def _normalised(cell: str) -> str:
    """A header cell as it is compared: ``x_mm`` for ``X [mm]`` or ``position (mm)``; either micro sign as ``u``."""
    name = _plain(cell)
    found = _NAME_AND_UNIT.fullmatch(name)
    # Without a sign between them "xm" would be x in m; such a name is left as it is.
    if found is None or found.end(1) == found.start(2):
        return name
    return f"{_SYNONYMS.get(found[1], found[1])}_{found[2]}"


def _plain(cell: str) -> str:
    return cell.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")


def _find_column(where: str, header: Sequence[str], quantity: Quantity) -> Column:
    found = [at for at, name in enumerate(header) if name in quantity.columns]
    if len(found) == 1:
        return Column(quantity, quantity.columns[header[found[0]]], found[0])
    option = f"--{quantity.name}-column"
    if found:
        places = " and ".join(f"{header[at]} (column {at + 1})" for at in found)
        raise SurveyError(f"{where}: {quantity.name} is given twice, as {places}; keep one, or choose it by {option}")
    hint = f" (column '{quantity.name}' carries no unit)" if quantity.name in header else ""
    also = ", ".join(f"'{name} [UNIT]'" for name, meant in _SYNONYMS.items() if meant == quantity.name)
    raise SurveyError(
        f"{where}: no column for {quantity.name}{hint}; found: {', '.join(header)}; allowed: one of "
        f"{', '.join(quantity.columns)}, or {also}, between commas, semicolons or tabs; straightcomp map build takes "
        f"another name by {option}"
    )
