"""The columns of a survey: which lengths they hold, in which unit, and how large those of a guide are."""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
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
    """A CSV file of a survey: normalised header, the columns of x and deviation, line number and cells of each row."""

    header: list[str]
    x: Column
    deviation: Column
    rows: list[tuple[int, list[str]]]


_SYNONYMS = {"position": "x", "target": "x", "straightness": "deviation"}
"""What instruments call the two quantities."""
_NAME_AND_UNIT = re.compile(r"([a-z]+)[\s_]*[\[(]?\s*(m|mm|um|nm)\s*[\])]?")


def read_table(path: Path) -> Table:
    """Read the header and the rows of a CSV file.

    Raises:
        SurveyError: the file cannot be read or is empty, lacks a column, or has a row of another length.
    """
    rows = list(_csv_rows(path))
    if not rows:
        raise SurveyError(f"survey {path}: is empty; allowed: a header row, and a row for each point")
    header_line, cells = rows.pop(0)
    header = [_normalised(cell) for cell in cells]
    x, deviation = (_find_column(f"survey {path}, line {header_line}", header, name) for name in (X, DEVIATION))
    for line, row in rows:
        if len(row) != len(header):
            raise SurveyError(
                f"survey {path}, line {line}: {len(row)} cells, the header has {len(header)} "
                "(is there a decimal comma?)"
            )
    return Table(header, x, deviation, rows)


def _csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    delimiter = ""
    for line, text in numbered_lines(path, r"^\s*#.*"):
        delimiter = delimiter or next((mark for mark in "\t;" if mark in text), ",")
        cells = next(csv.reader([text], delimiter=delimiter))
        # Where the comma does not separate cells it is a decimal point, as spreadsheets of many countries write it.
        yield line, cells if delimiter == "," else [cell.replace(",", ".") for cell in cells]


def _normalised(cell: str) -> str:
    """A header cell as it is compared: ``x_mm`` for ``X [mm]`` or ``position (mm)``; either micro sign as ``u``."""
    name = cell.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    found = _NAME_AND_UNIT.fullmatch(name)
    # Without a sign between them "xm" would be x in m; such a name is left as it is.
    if found is None or found.end(1) == found.start(2):
        return name
    return f"{_SYNONYMS.get(found[1], found[1])}_{found[2]}"


def _find_column(where: str, header: Sequence[str], quantity: Quantity) -> Column:
    units = {f"{quantity.name}_{unit}": unit for unit in quantity.per_metre}
    found = [name for name in units if name in header]
    if len(found) == 1:
        return Column(quantity, units[found[0]], header.index(found[0]))
    if found:
        raise SurveyError(f"{where}: {quantity.name} is given twice, as {' and '.join(found)}; keep one")
    hint = f" (column '{quantity.name}' carries no unit)" if quantity.name in header else ""
    raise SurveyError(
        f"{where}: no column for {quantity.name}{hint}; found: {', '.join(header)}; "
        f"allowed: one of {', '.join(units)}, separated by commas"
    )
