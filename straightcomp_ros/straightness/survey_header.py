"""What the columns of a survey are, by the names that people and instruments give them.

The name ends with the unit: x in m, mm, um or in (inch), deviation in m, mm, um, nm, in or uin. The names of
instruments and spreadsheets are known too: ``Position (mm)``, ``Straightness [µm]``. Each run may have a column of its
own: ``Run 1 forward [µm]``, ``Run 1- [µm]``. Other columns are ignored, but one that may be a run too.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

Direction = Literal["forward", "backward"]
WAYS: tuple[Direction, ...] = ("forward", "backward")


class SurveyError(ValueError):
    """A survey cannot be used; the message names the file, the line or the position, the value and what is allowed."""


PER_METRE = {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9, "in": 1.0 / 0.0254, "uin": 1e6 / 0.0254}
"""How many of a unit make a metre."""


class Quantity(NamedTuple):
    """A length in a survey: how many of the unit make a metre by the names that its column may have, what instruments
    call it, and the allowed extent (largest minus smallest value) of a run in m. An extent outside of it is more likely
    a wrong unit than an odd machine."""

    name: str
    columns: Mapping[str, float]
    synonyms: tuple[str, ...]
    smallest: float
    largest: float


X = Quantity(
    "x", {f"x_{unit}": PER_METRE[unit] for unit in ("m", "mm", "um", "in")}, ("position", "target"), 0.01, 20.0
)
DEVIATION = Quantity(
    "deviation",
    {f"deviation_{unit}": per_metre for unit, per_metre in PER_METRE.items()},
    ("straightness",),
    1e-8,
    5e-3,
)
DIRECTIONS: dict[str, Direction] = {
    **dict.fromkeys(["forward", "forwards", "fwd"], "forward"),
    **dict.fromkeys(["backward", "backwards", "bwd", "reverse", "rev"], "backward"),
}
_VAGUE_WAYS = {"back", "bkwd", "forth", "rearward", "return", "reversed"}
"""Words for a direction that may mean either, or something else."""
_RUN_WORDS = {"run", "cycle", "pass", "series", "measurement"}
"""What the column of one run may be called, with its number, its direction or both."""
_BETWEEN = "-.#"
"""Signs that may stand between the words of a run, as in ``Run #1``, ``Run 1 - forward``."""
COMPUTED = {
    *["mean", "average", "avg", "median", "max", "min", "range", "rms", "std", "sd", "s", "sigma", "σ", "ø"],
    *["repeatability", "uncertainty"],
}
"""What names a figure of runs among the columns of runs."""
TIME_COLUMN = "time_s"
"""Of a recording over time."""
_UNITS = "|".join(PER_METRE)
_INCH = re.compile(r"(?<![a-z])(u|micro)?inch(?:es)?\b")
_LAST_UNIT = re.compile(rf"(.*?(?:(?<=\d)-(?=[\s_]))?)(?:[\s_.:-]+|[\s_]*[\[(/,]\s*|(?<!.))({_UNITS})\s*[\])]?")
_NO_LENGTH = re.compile(rf"[\[(][^\])]*$|\d[.,]\d+\s*$|\b(?:{'|'.join({*PER_METRE} - {'in'})}|per)\s*$")
"""What before a unit makes another one of it: the opened bracket of ``(0.1 µm)``, the slope of ``µm/m``."""
_UNIT_WITHIN = re.compile(
    rf"(.*?)\s*[\[(]\s*({_UNITS})\s*[\])]\s*(?=\S)([+-]?)"
    rf"((?:[\W\d_]|{'|'.join([*DIRECTIONS, *_RUN_WORDS, *_VAGUE_WAYS])})*)"
)
"""A name with a direction or a number behind its unit, as ``Run 1 [um] forward``; ``Run 1 [um] smoothed`` is no run."""
_UNKNOWN_UNIT = re.compile(r"[\[(](?:[\s-]*|u|mic\w*)[\])]")
"""What stands in place of a unit: ``[]``, ``(-)``, ``[microns]``."""
_NUMBERED = re.compile(r"(?<=[a-z\])])\.\d+$")
"""How programs number the second of two equal names, as ``x_mm.1``."""
_LONGEST_NAME = 200
"""Characters of a column's name that are read: its patterns take time by the square of its length."""


class Column(NamedTuple):
    """What the name of a column says.

    Attributes:
        name: in lower case, with ``u`` for µ; ``x_mm`` or ``deviation_um`` for the column of a quantity.
        quantity: of the column, if it is the survey's x or deviation; None for a run, and for what no survey needs.
        unit: a key of :data:`PER_METRE`; empty if the name has none.
        words: all words, numbers and signs but the unit.
    """

    name: str
    quantity: Quantity | None
    unit: str
    words: tuple[str, ...]

    @property
    def ways(self) -> list[Direction]:
        """The directions that it names."""
        return [DIRECTIONS[word] for word in self.words if word in DIRECTIONS]

    @property
    def is_run(self) -> bool:
        """Whether it is the deviation in one run."""
        return self.quantity is None and self.unit != "" and self._of_one_run(())

    @property
    def seems_run(self) -> bool:
        """Whether it is a run, or is one by its number or its direction, or has no name but a unit."""
        named = self._of_one_run(_VAGUE_WAYS) and (self.ways or self._numbers)
        return self.is_run or (bool(named) if self.words else self.unit != "")

    @property
    def may_be_run(self) -> bool:
        """Whether its name does not exclude that it is one run."""
        called = {*self.words}.intersection([*DIRECTIONS, *_RUN_WORDS, *_VAGUE_WAYS])
        several = max(len(self.ways), len(self._numbers)) > 1
        return self.unit != "" and bool(called) and not several and not COMPUTED.intersection(self.words)

    @property
    def run(self) -> tuple[str, ...]:
        """Its direction and its number, as far as it has them."""
        return *self.ways, *self._numbers

    @property
    def _numbers(self) -> list[str]:
        return [word for word in self.words if word.isdigit()]

    def _of_one_run(self, also: Collection[str]) -> bool:
        """Whether it is called one run, by words for it, or ``also`` by these. A difference, a mean or a deviation of
        runs says so by a second number, a sign or a word."""
        known = [*DIRECTIONS, *_RUN_WORDS, *also, DEVIATION.name, *DEVIATION.synonyms, *_BETWEEN]
        others = {*self.words}.difference(known)
        called = not _RUN_WORDS.isdisjoint(self.words) or bool(self.ways)
        return called and len(self.ways) <= 1 and len(self._numbers) <= 1 and all(map(str.isdigit, others))


def column_named(cell: str) -> Column:
    """The column that has this name."""
    text = cell.strip().lower()
    text = text if len(text) <= _LONGEST_NAME else f"{text[:_LONGEST_NAME]}…"
    text = text.replace("\u00b5", "u").replace("\u03bc", "u").replace("\u2212", "-")
    text = _INCH.sub(lambda found: "uin" if found[1] else "in", text)
    plain = _NUMBERED.sub("", text)
    if within := _UNIT_WITHIN.fullmatch(plain):
        before, unit, sign, behind = within.groups()
        said = f"{before}{sign} {behind}".strip()
    elif (last := _LAST_UNIT.fullmatch(plain)) and not _NO_LENGTH.search(last[1]):
        said, unit = last.groups()
    else:
        said, unit, plain = _UNKNOWN_UNIT.sub("", text).strip(), "", text
    # A sign after the number of a run is its direction, as in "Run 1-".
    said = re.sub(r"(?<=\d)[+-]$", lambda sign: " forward" if sign[0] == "+" else " backward", said)
    words = re.findall(r"\d+|[^\W\d_]+|[^\s\w]", said)
    number = [text[len(plain) + 1 :]] if plain != text else []
    for quantity in (X, DEVIATION):
        called = words in [[one] for one in (quantity.name, *quantity.synonyms)]
        # A second x may be that of some of the runs.
        if called and f"{quantity.name}_{unit}" in quantity.columns and not (number and quantity is X):
            return Column(f"{quantity.name}_{unit}", quantity, unit, (*words, *number))
    # Of two runs that are both called "Forward" it is the second's number.
    return Column(text, None, unit, (*words, *(number if not any(map(str.isdigit, words)) else ())))


Chosen = Mapping[str, Column]
"""Columns that were chosen by their own names, by the name of their quantity."""


def chosen_columns(path: object, names: Mapping[str, str]) -> Chosen:
    """The columns with these ``names`` in a file, with their units at the end, by the name of the quantity."""
    found = {}
    for quantity, name in names.items():
        found[quantity] = column_named(name)
        if not found[quantity].unit:
            raise SurveyError(
                f"survey {path}: --{quantity}-column {name!r}: its name does not end with a unit; allowed: one of "
                f"{', '.join(PER_METRE)}, as in '{name} [mm]'"
            )
    return found


def columns(cells: Iterable[str], chosen: Chosen) -> list[Column]:
    """The columns of a header. Where that of a quantity is ``chosen``, no other is meant."""
    found = []
    for one in map(column_named, cells):
        for quantity in (X, DEVIATION):
            name = f"{quantity.name}_{one.unit}"
            if quantity.name in chosen and one[2:] == chosen[quantity.name][2:] and name in quantity.columns:
                one = one._replace(name=name, quantity=quantity)
                break
        else:
            if one.quantity and one.quantity.name in chosen:
                one = one._replace(name=f"({one.name})", quantity=None)
        found.append(one)
    return found


def runs_of(header: Sequence[Column]) -> dict[int, Column]:
    """The columns of the runs of a file that has one for each, by their places; empty for another file."""
    found = {at: one for at, one in enumerate(header) if one.is_run}
    alike = len({(one.unit, bool(one.ways)) for one in found.values()}) == 1
    named = any(one.quantity is DEVIATION or one.name in ("run", "direction") for one in header)
    return found if alike and not named else {}


def is_complete(header: Sequence[Column]) -> bool:
    """Whether the header has a column of x and one of deviation, or one for each run."""
    quantities = [one.quantity for one in header]
    return X in quantities and (DEVIATION in quantities or bool(runs_of(header)))


def column_of(quantity: Quantity, where: str, header: Sequence[Column]) -> int:
    """Place of the one column in ``header`` that is of ``quantity``; SurveyError without one, or with two."""
    found = [at for at, one in enumerate(header) if one.quantity is quantity]
    if len(found) == 1:
        return found[0]
    option = f"--{quantity.name}-column"
    if found:
        places = " and ".join(f"{header[at].name} (column {at + 1})" for at in found)
        raise SurveyError(f"{where}: {quantity.name} is given twice, as {places}; keep one, or choose it by {option}")
    names = [one.name for one in header]
    hint = f" (column '{quantity.name}' carries no unit)" if quantity.name in names else ""
    also = ", ".join(f"'{name} [UNIT]'" for name in quantity.synonyms)
    raise SurveyError(
        f"{where}: no column for {quantity.name}{hint}; found: {', '.join(names)}; allowed: one of "
        f"{', '.join(quantity.columns)}, or {also}, between "
        f"commas, semicolons or tabs; straightcomp map build takes another name by {option}"
    )
