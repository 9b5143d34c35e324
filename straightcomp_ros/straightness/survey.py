"""The survey file: the measured deviation of the guide, as CSV.

    # any comment
    run,direction,x_mm,deviation_um
    1,forward,0,-3.796
    1,forward,10,-3.12

The column's name ends with the unit: x in m, mm, um or in (inch), deviation in m, mm, um, nm, in or uin. The names and
separators of instruments and spreadsheets are read as well: ``Position (mm)``, ``Straightness [µm]``, semicolons or
tabs between the cells, and then decimal commas; lines before the header, and Excel's ``sep=``. ``run`` and
``direction`` may be left out: another run then begins where x turns back or begins anew, and the trend of x gives the
direction. Rows with the same run and direction belong to one run, so that a cycle may count forward and backward as
one. Each run may have a column of its own in place of these: ``Run 1 forward [µm]``. Other columns are ignored.
"""

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.yaml_text import marked_encoding

Direction = Literal["forward", "backward"]
MARK = "encoder reference"
"""Name of the fact that says which reference of the encoder x was counted from."""
Groups = dict[tuple[str, Direction | None], list[tuple[int, float, float]]]
"""Points (line, x in m, deviation in m) by the name and the direction of their run."""


class SurveyError(ValueError):
    """A survey cannot be used; the message names the file, the line or the position, the value and what is allowed."""


_ENCODINGS = ("utf-8", "cp1252")
"""The second is that of spreadsheets and instruments in Western Europe and America; names and units have its µ."""


def numbered_lines(path: Path, comment: str = "(?!)") -> Iterator[tuple[int, str]]:
    """Number and text of the lines of a text file without comments, which the pattern ``comment`` matches, and without
    the lines that are then blank; SurveyError if it cannot be read, or has another encoding.

    The first of :data:`_ENCODINGS` that fits is taken, or what a byte order mark says.
    """
    try:
        if path.exists() and not path.is_file():
            raise SurveyError(f"survey {path}: is no file; name a text file")
        content = path.read_bytes()
    except OSError as error:
        raise SurveyError(f"survey {path}: cannot be read: {error.strerror}") from error
    marked = marked_encoding(content)
    for encoding in (marked,) if marked else _ENCODINGS:
        try:
            text = content.decode(encoding)
            break
        except UnicodeDecodeError as error:
            failed = error
    else:
        raise SurveyError(f"survey {path}: byte {failed.start} is not UTF-8; save the file as UTF-8 text") from failed
    if "\0" in text:
        raise SurveyError(f"survey {path}: character {text.index(chr(0))} is NUL; save the file as UTF-8 text")
    for number, raw in enumerate(text.splitlines(), start=1):
        if len(raw) > _LONGEST_LINE:
            raise SurveyError(f"survey {path}, line {number}: {len(raw)} characters; allowed: <= {_LONGEST_LINE}")
        line = re.sub(comment, "", raw)
        if line.strip():
            yield number, line


def number(where: str, name: str, cell: str) -> float:
    """``cell`` as a finite number, or SurveyError; ``where`` begins the message, ``name`` says what the cell is."""
    try:
        value = float(cell.replace("_", "?"))  # "1_000" is a number to Python alone
    except ValueError:
        raise SurveyError(f"{where}: {name} {cell!r}; allowed: a number") from None
    if not math.isfinite(value):
        raise SurveyError(f"{where}: {name} {cell!r}; allowed: a finite number")
    return value


def decimal(value: float, places: int) -> str:
    """Fixed point, ``places`` > 0, without trailing zeros: ``10``, ``-0.482``; never ``-0``."""
    text = f"{value:.{places}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


@dataclass(frozen=True, eq=False)
class Run:
    """One run along the guide, x ascending whichever way the stage moved.

    Attributes:
        name: the run's label in its file.
        direction: ``forward`` when the stage moved towards larger x.
        x: (n,) slider position in m, strictly ascending.
        deviation: (n,) deviation of the guide in m at x.
    """

    name: str
    direction: Direction
    x: NDArray[np.float64]
    deviation: NDArray[np.float64]


@dataclass(frozen=True)
class Survey:
    """All runs of a survey, in the order of the file; ``source`` is the file's name for messages. ``facts`` are what
    the comments at the file's head say as ``name: text``, by name."""

    runs: tuple[Run, ...]
    source: str = "survey"
    facts: Mapping[str, str] = field(default_factory=dict, compare=False)

    @property
    def mark(self) -> str:
        """The encoder's reference that x was counted from; empty if the file does not name it."""
        return self.facts.get(MARK, "")

    def in_direction(self, direction: Direction) -> tuple[Run, ...]:
        """The runs of one direction."""
        return tuple(run for run in self.runs if run.direction == direction)


class Quantity(NamedTuple):
    """A length in a survey: how many of the unit make a metre by the names that its column may have, and the allowed
    extent (largest minus smallest value) of a run in m. An extent outside of it is more likely a wrong unit than an odd
    machine."""

    name: str
    columns: Mapping[str, float]
    smallest: float
    largest: float


PER_METRE = {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9, "in": 1.0 / 0.0254, "uin": 1e6 / 0.0254}
"""How many of a unit make a metre."""


def _quantity(name: str, units: str, smallest: float, largest: float) -> Quantity:
    return Quantity(name, {f"{name}_{unit}": PER_METRE[unit] for unit in units.split()}, smallest, largest)


X = _quantity("x", "m mm um in", 0.01, 20.0)
DEVIATION = _quantity("deviation", "m mm um nm in uin", 1e-8, 5e-3)


class Row(NamedTuple):
    """Line number, text of each cell by its column's normalised name, and x and deviation in m."""

    line: int
    cells: dict[str, str]
    x: float
    deviation: float


class Table(NamedTuple):
    """A CSV file of a survey: its normalised header, the columns of x and deviation, its rows, and its facts."""

    header: list[str]
    columns: tuple[str, str]
    rows: list[Row]
    facts: dict[str, str]


_SYNONYMS = {"position": "x", "target": "x", "straightness": "deviation"}
"""What instruments call the two quantities."""
_NAME_AND_UNIT = re.compile(rf"([a-z]+)[\s_]*[\[(/]?\s*({'|'.join(PER_METRE)})\s*[\])]?")
_OWN_UNIT = re.compile(rf".*?[^a-z]({'|'.join(PER_METRE)})\s*[\])]?")
_RUN_WORDS = {"run", "cycle", "pass", "series", "measurement"}
"""What the column of one run may be called, with its number, its direction or both."""
_DIRECTIONS: dict[str, Direction] = {"forward": "forward", "fwd": "forward", "backward": "backward", "bwd": "backward"}
_COLUMN = "column of the run"
"""Name of the cell that says which column a point is from."""
_INCH = re.compile(r"(?<![a-z])(u|micro)?inch(?:es)?\b")
_DELIMITERS = "\t;,"
_SEPARATOR_LINE = re.compile(r"sep=(.)", re.IGNORECASE)
"""Excel's own first line, which names the delimiter."""
_LONGEST_LINE = 100_000
"""Characters; the csv module reads cells of some more."""
_LINES_BEFORE = 100
"""Lines in which the header is looked for: instruments write some tens of lines about the measurement before it."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""A number whose mark may separate thousands."""
_SPACED = re.compile(r"(?<=\d)['\u2019\s](?=\d{3}(?!\d))")
"""What can only separate thousands: a space, of any width, as in France, or an apostrophe, as in Switzerland."""
OTHER_KINDS = {
    "aerotech": r":START2?D?\b",
    "crosscomp": r"kw\.crosscomp\.",
    "etalon": r"(?i)gridpoints\s*=",
    "linuxcnc": r"\A(?:\s*[-+]?[\d.]+){3}\s*$",
    "renishaw": r"(?i)run target data\s*:",
    "api": r"(?i)position\s+\w+[\w\s]*avg error",
}
"""What the text of a file has that `straightcomp map convert` makes a survey of, by the name of its format."""


def table_of(path: Path, every: Sequence[tuple[int, str]], names: Mapping[str, str] | None = None) -> Table:
    """The header and the rows of a CSV file with these :func:`numbered_lines`.

    ``names`` has the file's own name, with its unit at the end, for the column of ``x`` or of ``deviation``.

    Raises:
        SurveyError: the file is empty, lacks a column or has it twice, has a row of another length,
            a cell that is no finite number, or numbers with points and commas in one another's place.
    """
    lines = [(line, text) for line, text in every if not text.lstrip().startswith("#")]
    if not lines:
        raise SurveyError(f"survey {path}: is empty; allowed: a header row, and a row for each point")
    own = {}
    for quantity, name in (names or {}).items():
        unit = _OWN_UNIT.fullmatch(_plain(name))
        own[_spelled(name)] = f"{quantity}_{unit[1]}" if unit else _spelled(name)
    first, delimiter, header = _header(lines, own)
    runs = _columns_of_runs(header)
    try:
        header_line = f"survey {path}, line {lines[first - 1][0]}"
        x = _column(header_line, header, X)
        deviation = header[runs[0]].partition(" ")[0] if runs else _column(header_line, header, DEVIATION)
    except SurveyError as error:
        text = "\n".join(text for _, text in lines)
        kind = next((name for name, mark in OTHER_KINDS.items() if re.search(mark, text, re.MULTILINE)), None)
        if kind is None:
            raise
        raise SurveyError(
            f"survey {path}: is a file of another kind ({kind}); make a survey of it with "
            f"straightcomp map convert {path} --format {kind} -o survey.csv"
        ) from error
    rows = [
        (f"survey {path}, line {line}", line, next(csv.reader([text], delimiter=delimiter)))
        for line, text in lines[first:]
    ]
    for where, _, row in rows:
        if len(row) != len(header):
            raise SurveyError(f"{where}: {len(row)} cells, the header has {len(header)} (is there a decimal comma?)")
    numbers = [at for at, name in enumerate(header) if at in runs or name in (x, deviation, "time_s")]
    for _, _, row in rows:
        for column in numbers:
            row[column] = _SPACED.sub("", row[column]).replace("\u2212", "-")
    if delimiter != ",":
        _use_points(rows, numbers)
    if runs:
        header, rows = _a_row_for_each(runs, header, rows)
    found = []
    for where, line, row in rows:
        cells = dict(zip(header, map(str.strip, row), strict=True))
        # Division keeps a decimal number the nearest float.
        at = number(where, x, cells[x]) / X.columns[x]
        found.append(Row(line, cells, at, number(where, deviation, cells[deviation]) / DEVIATION.columns[deviation]))
    comments = (text.strip(" \t#").partition(": ") for _, text in every if text.lstrip().startswith("#"))
    return Table(header, (x, deviation), found, {name: text.strip() for name, colon, text in comments if colon})


def _header(lines: Sequence[tuple[int, str]], own: Mapping[str, str]) -> tuple[int, str, list[str]]:
    """Index of the line after the first header with both columns, its delimiter and cells; units may have a line of
    their own below the names. If none has them, of the first line but Excel's own."""
    named = _SEPARATOR_LINE.fullmatch(lines[0][1].strip())
    first = 1 if named and len(lines) > 1 else 0
    delimiters = named[1] if named else _DELIMITERS
    for at in range(first, min(len(lines) - 1, _LINES_BEFORE)):
        for delimiter in delimiters:
            names, below = (next(csv.reader([text], delimiter=delimiter)) for _, text in (lines[at], lines[at + 1]))
            for size, cells in enumerate((names, map(" ".join, zip(names, below, strict=False))), 1):
                header = _cells(cells, own)
                missing = [one for one in (X, DEVIATION) if not any(name in header for name in one.columns)]
                if not missing or (missing == [DEVIATION] and _columns_of_runs(header)):
                    return at + size, delimiter, header
    delimiter = next((mark for mark in delimiters if mark in lines[first][1]), ",")
    return first + 1, delimiter, _cells(next(csv.reader([lines[first][1]], delimiter=delimiter)), own)


def _cells(names: Iterable[str], own: Mapping[str, str]) -> list[str]:
    """The cells of a header as they are compared: ``x_mm`` for ``X [mm]``, ``position (mm)``, or a name of ``own``.

    Where the column of a quantity is chosen by its own name, no other is meant.
    """
    chosen = {name.partition("_")[0] for name in own.values()}
    found = []
    for cell in names:
        name = _spelled(cell)
        quantity, _, unit = name.rpartition("_")
        quantity = _SYNONYMS.get(quantity, quantity)
        usual = f"{quantity}_{unit}" if unit in PER_METRE else name
        other = f"({usual})" if unit in PER_METRE and quantity in chosen else usual
        of_run = "" if "deviation" in chosen else _of_run(cell)
        found.append(own.get(name) or of_run or other)
    return found


def _of_run(name: str) -> str:
    """``deviation_um (forward run)`` for ``Run 1 fwd [µm]``, the column of a run; empty for another name."""
    unit = _OWN_UNIT.fullmatch(_plain(name))
    words = re.findall(r"[a-z]+", unit[0][: unit.start(1)]) if unit else []
    ways = [_DIRECTIONS[word] for word in words if word in _DIRECTIONS]
    others = set(words) - _DIRECTIONS.keys() - _RUN_WORDS - {"deviation", "straightness"}
    if unit is None or others or len(ways) > 1 or not (ways or _RUN_WORDS.intersection(words)):
        return ""
    return f"deviation_{unit[1]} ({' '.join([*ways, 'run'])})"


def _columns_of_runs(header: Sequence[str]) -> list[int]:
    """Where the runs are that have a column each, if the file is one of these."""
    found = [at for at, name in enumerate(header) if " " in name and name.partition(" ")[0] in DEVIATION.columns]
    units = {header[at].partition(" ")[0] for at in found}
    directed = {header[at].endswith("(run)") for at in found}
    other = {"run", "direction", "time_s", *DEVIATION.columns}.intersection(header)
    return found if len(units) == len(directed) == 1 and not other else []


def _a_row_for_each(
    runs: Sequence[int], header: Sequence[str], rows: Sequence[tuple[str, int, list[str]]]
) -> tuple[list[str], list[tuple[str, int, list[str]]]]:
    """Header and rows with one column of deviation in place of one for each of ``runs``; an empty cell is no point."""
    shared = [at for at in range(len(header)) if at not in runs]
    found = [
        (where, line, [*(row[at] for at in shared), f"{at}", header[at].split()[1].lstrip("("), row[at]])
        for where, line, row in rows
        for at in runs
        if row[at].strip()
    ]
    unit, way = header[runs[0]].split()[:2]
    return [*(header[at] for at in shared), _COLUMN, "" if way == "(run)" else "direction", unit], found


def _spelled(name: str) -> str:
    """``position_mm`` for ``Position [mm]``; a name of another form in lower case."""
    parts = _NAME_AND_UNIT.fullmatch(_plain(name))
    # Without a sign between them "xm" would be x in m; such a name is left as it is.
    return f"{parts[1]}_{parts[2]}" if parts and parts.end(1) != parts.start(2) else _plain(name)


def _plain(cell: str) -> str:
    """In lower case, with either micro sign as ``u``, and inches as ``in``."""
    text = cell.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    return _INCH.sub(lambda found: "uin" if found[1] else "in", text)


def _use_points(rows: Sequence[tuple[str, int, list[str]]], columns: Sequence[int]) -> None:
    """Make points of decimal commas, and leave the marks out that separate thousands."""
    cells = [(where, row, column, row[column].strip()) for where, _, row in rows for column in columns]
    texts = [cell for *_, cell in cells]
    marks = {mark for mark in ".," if any(mark in cell for cell in texts)}
    decimal = {max(".,", key=cell.rfind) for cell in texts if "." in cell and "," in cell}
    decimal = decimal or {
        mark for mark in marks if any(mark in cell and not _GROUPED.fullmatch(cell) for cell in texts)
    }
    if len(marks) == 2 and len(decimal) != 1:
        where = next(where for where, *_, cell in cells if "," in cell)
        raise SurveyError(
            f"{where}: the numbers have points and commas, and either may be the decimal mark; "
            "allowed: one decimal mark, and thousands without any"
        )
    point = "".join(decimal if len(marks) == 2 else marks)
    other = "," if point == "." else "."
    for where, row, column, cell in cells:
        whole, mark, fraction = cell.partition(point) if point else (cell, "", "")
        if other in cell and (other in fraction or not _GROUPED.fullmatch(whole)):
            raise SurveyError(
                f"{where}: {cell!r}; allowed: a number with {point!r} as the decimal mark, as in other lines"
            )
        row[column] = whole.replace(other, "") + ("." + fraction if mark else "")


def _column(where: str, header: Sequence[str], quantity: Quantity) -> str:
    """The one name in ``header`` that is of ``quantity``."""
    found = [at for at, name in enumerate(header) if name in quantity.columns]
    if len(found) == 1:
        return header[found[0]]
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


def read_survey(
    path: str | Path, *, min_points: int = 20, max_gap: float = 0.05, names: Mapping[str, str] | None = None
) -> Survey:
    """Read and check a survey: at least ``min_points`` in a run, at most ``max_gap`` in m between neighbouring points.
    ``names`` as :func:`table_of` takes it. A file that has not changed gives the same survey again.

    Raises:
        SurveyError: the file is missing or empty, lacks a column, has a cell that is no finite number, too few points,
            an x that turns back or repeats, a gap, or values that no guide in these units has.
    """
    path = Path(path)
    return _survey_of(path, tuple(numbered_lines(path)), min_points, max_gap, tuple((names or {}).items()))


@lru_cache(maxsize=8)
def _survey_of(
    path: Path, lines: tuple[tuple[int, str], ...], min_points: int, max_gap: float, names: tuple[tuple[str, str], ...]
) -> Survey:
    table = table_of(path, lines, dict(names))
    groups: Groups = {}
    for line, cells, x, deviation in table.rows:
        word = cells.get("direction", "").lower()
        if "direction" in cells and word not in _DIRECTIONS:
            raise SurveyError(
                f"survey {path}, line {line}: direction {word!r}; allowed: forward or backward, fwd or bwd"
            )
        direction = _DIRECTIONS.get(word)
        key = (cells.get("run", cells.get(_COLUMN, "1")), direction)
        groups.setdefault(key, []).append((line, x, deviation))
    if not groups:
        raise SurveyError(f"survey {path}: has a header but no rows; allowed: at least {min_points} rows")
    if "run" not in table.header:
        groups = _split(groups)
    runs = []
    for (name, way), points in groups.items():
        where = f"survey {path}, run '{name}'{f' {way}' if way else ''}"
        if len(points) < max(min_points, 2):
            raise SurveyError(f"{where}: {len(points)} points; allowed: >= {min_points} (min_points)")
        runs.append(orient(where, name, way, points))
        check_run(where, runs[-1], max_gap, table.columns)
    return Survey(tuple(runs), str(path), table.facts)


def _split(groups: Groups) -> Groups:
    """The runs of a file that names none: another one begins where x turns back or begins anew.

    As they are where one would cover half of x or less: there x does not begin anew, it is wrong.
    """
    found, numbers = Groups(), Counter[Direction]()
    for (name, direction), points in groups.items():
        parts, way = [points[:1]], 0.0
        for before, point in itertools.pairwise(points):
            step = math.copysign(1.0, point[1] - before[1]) if point[1] != before[1] else 0.0
            if way and step != way:
                # Where x stands still at the turning point, the way back begins with the second point.
                parts.append([])
                step = 0.0
            parts[-1].append(point)
            way = step
        whole = max(x for _, x, _ in points) - min(x for _, x, _ in points)
        if min(abs(part[-1][1] - part[0][1]) for part in parts) <= whole / 2.0:
            found[name, direction] = points
            continue  # It is refused as a run that turns back.
        for part in parts:
            of_part: Direction = direction or ("forward" if part[-1][1] > part[0][1] else "backward")
            numbers[of_part] += 1
            found[str(numbers[of_part]), of_part] = part
    return found


def write_survey(path: str | Path, survey: Survey, comments: Sequence[str] = ()) -> None:
    """Write ``survey`` in mm and µm, to 0.1 µm in x and 1 nm in deviation; backward runs as driven, x falling.

    ``path`` is replaced in one step if it exists; ``comments`` are the lines at its head, without the ``#``.
    """
    lines = [*(f"# {comment}" for comment in comments), "run,direction,x_mm,deviation_um"]
    for run in survey.runs:
        order = slice(None) if run.direction == "forward" else slice(None, None, -1)
        lines += [
            f"{run.name},{run.direction},{decimal(x * 1e3, 4)},{decimal(deviation * 1e6, 3)}"
            for x, deviation in zip(run.x[order].tolist(), run.deviation[order].tolist(), strict=True)
        ]
    write_whole(path, "\n".join(lines) + "\n")


def orient(where: str, name: str, direction: Direction | None, points: Sequence[tuple[int, float, float]]) -> Run:
    """A run from its points in the order of the file; ``where`` begins the messages.

    ``points`` are at least two of (line number, x in m, deviation in m). A backward run may be listed as it was driven
    or sorted by x. A forward run with falling x contradicts itself and is refused, as is an x that does not go one way:
    SurveyError. Without ``direction``, the trend of x gives it.
    """
    lines, x, deviation = zip(*points, strict=True)
    steps = np.diff(x)
    rising = x[-1] > x[0] if x[-1] != x[0] else bool(steps[0] > 0.0)
    wrong = np.flatnonzero(steps <= 0.0 if rising else steps >= 0.0)
    if wrong.size:
        at = int(wrong[0]) + 1
        fault = "repeats" if x[at] == x[at - 1] else "turns back"
        raise SurveyError(
            f"{where}, line {lines[at]}: x {fault}: {x[at] * 1e3:.10g} mm after {x[at - 1] * 1e3:.10g} mm "
            f"(line {lines[at - 1]}); allowed: x that only {'rises' if rising else 'falls'} within a run"
        )
    if direction == "forward" and not rising:
        raise SurveyError(
            f"{where}, line {lines[1]}: direction is 'forward' but x falls to {x[1] * 1e3:.10g} mm; "
            "allowed: x that rises, or direction 'backward'"
        )
    values = np.array([x, deviation])[:, slice(None) if rising else slice(None, None, -1)]
    values.setflags(write=False)
    return Run(name, direction or ("forward" if rising else "backward"), *values)


def check_run(
    where: str, run: Run, max_gap: float = math.inf, columns: tuple[str, str] = ("x_m", "deviation_m")
) -> None:
    """Raise SurveyError for lengths that no guide has, with the unit in place of that of ``columns`` that would fit, or
    for neighbouring points farther apart than ``max_gap`` in m."""
    # Units before gaps: x in the wrong unit would else be called a gap of metres.
    for quantity, column, values in ((X, columns[0], run.x), (DEVIATION, columns[1], run.deviation)):
        _, units, low, high = quantity
        extent = float(np.ptp(values))
        if low <= extent <= high:
            continue
        fitting = [name for name, per_metre in units.items() if low <= extent * units[column] / per_metre <= high]
        hint = f"; is the unit wrong? It would fit as {' or '.join(fitting)}" if fitting else ""
        raise SurveyError(f"{where}: {column} extends over {extent:.6g} m; allowed: {low:g} m to {high:g} m{hint}")
    steps = np.diff(run.x)
    widest = int(np.argmax(steps))
    # A nanometre of grace: 0.05 m steps read from decimal text differ in the last bit.
    if steps[widest] > max_gap + 1e-9:
        raise SurveyError(
            f"{where}: no point between x = {run.x[widest] * 1e3:.10g} mm and {run.x[widest + 1] * 1e3:.10g} mm, "
            f"a gap of {steps[widest] * 1e3:.6g} mm; allowed: <= {max_gap * 1e3:.6g} mm (max_gap)"
        )
