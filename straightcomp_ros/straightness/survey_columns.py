"""The columns of a survey: which lengths they carry, in which unit, and of which size a guide's are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


class SurveyError(ValueError):
    """A survey cannot be used; the message names the file, the line or the place, the value and what is allowed."""


@dataclass(frozen=True)
class Quantity:
    """A length in a survey.

    Attributes:
        name: what the column's name begins with.
        per_metre: units that may follow the name, with how many of them make a metre.
        smallest, largest: allowed extent (largest minus smallest value) in a run, in m. Outside of
            it the unit is more likely wrong than the machine odd.
    """

    name: str
    per_metre: Mapping[str, float]
    smallest: float
    largest: float

    def column_names(self) -> str:
        """The accepted column names in words."""
        return ", ".join(f"{self.name}_{unit}" for unit in self.per_metre)

    def check_extent(self, where: str, extent: float, unit: str = "m") -> None:
        """Refuse a run whose ``extent`` in m, given in ``unit``, is not that of a guide; ``where`` opens the message.

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
    """Where a quantity stands in the rows of a file, and in which unit."""

    quantity: Quantity
    unit: str
    index: int

    def metres(self, number: float) -> float:
        """``number`` in this column's unit as m; divides, so that a decimal number stays the nearest float."""
        return number / self.quantity.per_metre[self.unit]


_SYNONYMS = {"position": "x", "target": "x", "straightness": "deviation"}
"""What instruments call the two quantities."""
_NAME_AND_UNIT = re.compile(r"([a-z]+)[\s_]*[\[(]?\s*(m|mm|um|nm)\s*[\])]?")


def normalised(cell: str) -> str:
    """A header cell as it is compared: ``x_mm`` for ``X [mm]``, ``position (mm)``; either micro sign as ``u``."""
    name = cell.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    found = _NAME_AND_UNIT.fullmatch(name)
    # Without a sign between them "xm" would be x in m; such a name is left as it is.
    if found is None or found.end(1) == found.start(2):
        return name
    return f"{_SYNONYMS.get(found[1], found[1])}_{found[2]}"


def find_column(where: str, header: Sequence[str], quantity: Quantity) -> Column:
    """The one column that holds ``quantity``; ``header`` is normalised, ``where`` opens the message.

    Raises:
        SurveyError: no such column, or more than one.
    """
    found = [
        Column(quantity, unit, header.index(f"{quantity.name}_{unit}"))
        for unit in quantity.per_metre
        if f"{quantity.name}_{unit}" in header
    ]
    if len(found) == 1:
        return found[0]
    if found:
        names = " and ".join(f"{quantity.name}_{column.unit}" for column in found)
        raise SurveyError(f"{where}: {quantity.name} is given twice, as {names}; keep one")
    hint = f" (column '{quantity.name}' carries no unit)" if quantity.name in header else ""
    raise SurveyError(
        f"{where}: no column for {quantity.name}{hint}; found: {', '.join(header)}; "
        f"allowed: one of {quantity.column_names()}, separated by commas"
    )
