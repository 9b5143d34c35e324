"""A table of measured points as people and instruments write it: its encoding, its header, its separators and marks.

The column's name ends with the unit: x in m, mm, um or in (inch), deviation in m, mm, um, nm, in or uin. The names and
separators of instruments and spreadsheets are read as well: ``Position (mm)``, ``Straightness [µm]``, semicolons or
tabs between the cells, and then decimal commas; lines before the header, and Excel's ``sep=``. Each run may have a
column of its own: ``Run 1 forward [µm]``, ``Run 1- [µm]``. Other columns are ignored, but one that may be a run too.
"""

import csv
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from straightcomp_ros.parameters.yaml_text import bounded_bytes, marked_encoding, number_or_nan

Direction = Literal["forward", "backward"]
WAYS: tuple[Direction, ...] = ("forward", "backward")


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
        content = bounded_bytes(path)
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


X = Quantity("x", {f"x_{unit}": PER_METRE[unit] for unit in ("m", "mm", "um", "in")}, 0.01, 20.0)
DEVIATION = Quantity("deviation", {f"deviation_{unit}": per_metre for unit, per_metre in PER_METRE.items()}, 1e-8, 5e-3)


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
_OF_X = re.compile(r"(?<![a-z])(?:x|position|target)(?![a-z])")
"""What is in the name of a further column of x, as ``Position back (mm)`` or ``x_mm.1``."""
_NAME_AND_UNIT = re.compile(rf"([a-z]+)[\s_]*[\[(/,]?\s*({'|'.join(PER_METRE)})\s*[\])]?")
_OWN_UNIT = re.compile(rf"(.*?(?:(?<=\d)-(?=[\s_]))?)(?:[\s_.:-]+|[\s_]*[\[(/,]\s*)({'|'.join(PER_METRE)})\s*[\])]?")
_NO_LENGTH = re.compile(rf"[\[(][^\])]*$|\d[.,]\d+\s*$|\b(?:{'|'.join({*PER_METRE} - {'in'})}|per)\s*$")
"""What before a unit makes another one of it: the opened bracket of ``(0.1 µm)``, the slope of ``µm/m``."""
_RUN_WORDS = {"run", "cycle", "pass", "series", "measurement"}
"""What the column of one run may be called, with its number, its direction or both."""
_NUMBER_OF_RUN = re.compile(r"(?:run|cycle)(?:[\s_]*(?:#|n[or]\b.?|number))?$")
"""What the column of the runs' names may be called too."""
DIRECTIONS: dict[str, Direction] = {
    **dict.fromkeys(["forward", "forwards", "fwd"], "forward"),
    **dict.fromkeys(["backward", "backwards", "bwd", "reverse", "rev"], "backward"),
}
_VAGUE_WAYS = {"back", "bkwd", "forth", "rearward", "return", "reversed"}
"""Words for a direction that may mean either, or something else."""
WAYS_IN_CELLS: dict[str, Direction] = {
    **DIRECTIONS,
    **dict.fromkeys(["f", "+", "1", "+1", "1.0"], "forward"),
    **dict.fromkeys(["b", "r", "-", "\u2212", "-1", "\u22121", "-1.0"], "backward"),
}
"""What a cell of the column of directions may say too."""
ALLOWED_WAYS = "forward or backward, fwd or bwd, reverse or rev, f or b, r, + or -, 1 or -1"
_OF_DIRECTIONS = re.compile(r"(?<![a-z])dir(?:ection)?s?(?![a-z])|(?<!vor)richtung|(?<![a-z])sens(?: d|$)")
"""What is in the name of a column of directions."""
_SIGNS = {"+": " forward", "-": " backward"}
"""What a sign after the number of a run means, as in ``Run 1-``."""
_BEHIND = "|".join([*DIRECTIONS, *_RUN_WORDS, *_VAGUE_WAYS])
_UNIT_WITHIN = re.compile(
    rf"(.*?)\s*([\[(]\s*(?:{'|'.join(PER_METRE)})\s*[\])])\s*(?=\S)([+-]?)((?:[\W\d_]|{_BEHIND})*)$"
)
"""A name with a direction or a number behind its unit, as ``Run 1 [um] forward``; ``Run 1 [um] smoothed`` is no run."""
_UNKNOWN_UNIT = re.compile(r"[\[(](?:[\s-]*|u|mic\w*)[\])]")
"""What stands in place of a unit: ``[]``, ``(-)``, ``[microns]``."""
_NUMBERED = re.compile(r"\.\d+$")
"""How programs number the second of two equal names, as ``x_mm.1``."""
_COMPUTED = {
    *["mean", "average", "avg", "median", "max", "min", "range", "rms", "std", "sd", "s", "sigma", "σ", "ø"],
    *["repeatability", "uncertainty"],
}
"""What names a figure of runs among the columns of runs."""
_RUN = re.compile(rf"(deviation_(?:{'|'.join(PER_METRE)})) \((?:(forward|backward) )?run(?: \d+)?\)")
"""What :func:`_of_run` makes of a run's column."""
TIME_COLUMN = "time_s"
"""Of a recording over time."""
RUN_COLUMN = "column of the run"
"""Name of the cell that says which column a point is from."""
_SINGLE = {"run", "direction", TIME_COLUMN, *X.columns, *DEVIATION.columns}
"""The columns in which each row has a cell."""
_INCH = re.compile(r"(?<![a-z])(u|micro)?inch(?:es)?\b")
_DELIMITERS = "\t;,"
_SEPARATOR_LINE = re.compile(r"sep=(.)", re.IGNORECASE)
"""Excel's own first line, which names the delimiter."""
_LONGEST_LINE = 100_000
"""Characters; the csv module reads cells of some more."""
_LONGEST_NAME = 200
"""Characters of a column's name that are read: its patterns take time by the square of its length."""
_COMMENT = re.compile(r'\s*(#|"#[^"]*"[\s;,]*$)')
"""Also as a spreadsheet writes it that has it in a cell."""
MARK = "encoder reference"
"""Name of the fact that says which reference of the encoder x was counted from."""
_LINES_BEFORE = 100
"""Lines in which the header is looked for: instruments write some tens of lines about the measurement before it."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""A number whose mark may separate thousands."""
_WHOLE = re.compile(r"[+-]?0*[1-9]\d*")
"""A whole number but zero."""
_SPACED = re.compile(r"(?<=\d)['\u2019\s](?=\d{3}(?!\d))")
"""What can only separate thousands: a space, of any width, as in France, or an apostrophe, as in Switzerland."""
OTHER_KINDS = {
    "aerotech": r":START2?D?\b",
    "crosscomp": r"kw\.crosscomp\.",
    "etalon": r"(?i)gridpoints\s*=",
    "linuxcnc": r"\A\s*[-+]?[\d.]+(?:\s+[-+]?[\d.]+){2}\s*$",
    "renishaw": r"(?i)run target data\s*:",
    "api": r"(?i)position\s+\w[\w\s]{,200}avg error",
}
"""What the text of a file has that `straightcomp map convert` makes a survey of, by the name of its format."""


def table_of(path: Path, every: Sequence[tuple[int, str]], names: Mapping[str, str] | None = None) -> Table:
    """The header and the rows of a CSV file with these :func:`numbered_lines`.

    ``names`` has the file's own name, with its unit at the end, for the column of ``x`` or of ``deviation``.

    Raises:
        SurveyError: the file is empty, lacks a column or has one that counts twice, has a row of another length,
            a cell that is no finite number, or numbers with points and commas in one another's place.
    """
    lines = [(line, text) for line, text in every if not _COMMENT.match(text)]
    if not lines:
        raise SurveyError(f"survey {path}: is empty; allowed: a header row, and a row for each point")
    own = {_spelled(name): _chosen(path, quantity, name) for quantity, name in (names or {}).items()}
    first, delimiter, header = _header(lines, own)
    if not _complete(header):
        # Programs that write numbers write the header as a comment.
        head = [(line, text.strip(' \t"#')) for line, text in every if _COMMENT.match(text) and line < lines[0][0]]
        at_head, mark, names_there = _header([*head, *lines], own)
        if _complete(names_there):
            lines, first, delimiter, header = [*head[:at_head], *lines], at_head, mark, names_there
    runs = _columns_of_runs(header)
    try:
        header_line = f"survey {path}, line {lines[first - 1][0]}"
        x = _column(header_line, header, X)
        deviation = next(iter(runs.values()))[0] if runs else _column(header_line, header, DEVIATION)
    except SurveyError as error:
        text = "\n".join(text for _, text in lines)
        kind = next((name for name, mark in OTHER_KINDS.items() if re.search(mark, text, re.MULTILINE)), None)
        if kind is None:
            raise
        raise SurveyError(
            f"survey {path}: its columns have no names; if it is a file of another kind ({kind}), make a survey of it "
            f"with straightcomp map convert {path} --format {kind} -o survey.csv; else begin it with a line such as "
            "x_mm,deviation_um, between commas, semicolons or tabs"
        ) from error
    positions = {x.partition("_")[2]} - {deviation.partition("_")[2]}
    known = bool(runs) or deviation in own.values() or {"run", "direction"} <= {*header}
    of_runs = [name for name in header if _unit_of_run(name) not in (None, *positions)]
    # The mean of one direction is no deviation: that is the other one.
    if not known and (len(of_runs) > 1 or any("ward run" in name for name in of_runs)):
        raise SurveyError(
            f"{header_line}: {deviation} stands among columns of runs; remove it, or choose it by --deviation-column"
        )
    for name in ("run", "direction", TIME_COLUMN):
        if header.count(name) > 1:
            raise SurveyError(f"{header_line}: {name} is given twice; allowed: one column of this name")
    rows = _rows(path, lines[first:], delimiter, header)
    if runs:
        _check_columns_of_runs(header_line, header, runs, rows)
        if x not in own.values():
            _check_other_x(header_line, header, header.index(x), runs, rows)
        header, rows = _a_row_for_each(runs, header, rows)
    numbers = [at for at, name in enumerate(header) if name in (x, deviation, TIME_COLUMN)]
    for _, _, row in rows:
        for column in numbers:
            row[column] = _SPACED.sub("", row[column]).replace("\u2212", "-")
    # Between commas a point is the decimal mark, unless a comma stands in a number, in quotes.
    if delimiter != "," or any("," in row[column] for _, _, row in rows for column in numbers):
        _use_points(rows, numbers, delimiter)
    found = []
    for where, line, row in rows:
        cells = dict(zip(header, map(str.strip, row), strict=True))
        # Division keeps a decimal number the nearest float.
        at = number(where, x, cells[x]) / X.columns[x]
        found.append(Row(line, cells, at, number(where, deviation, cells[deviation]) / DEVIATION.columns[deviation]))
    # A recording over time may have a counter or a sign of the speed in each row.
    header = header if TIME_COLUMN in header else _with_run(header, found)
    header = header if {"direction", TIME_COLUMN}.intersection(header) else _with_direction(header_line, header, found)
    return Table(header, (x, deviation), found, dict(_facts(text for _, text in every if _COMMENT.match(text))))


def _chosen(path: Path, quantity: str, name: str) -> str:
    """The column of this quantity that has the file's own name, as ``deviation_um``."""
    _, unit = _name_and_unit(name)
    if not unit:
        raise SurveyError(
            f"survey {path}: --{quantity}-column {name!r}: its name does not end with a unit; allowed: one of "
            f"{', '.join(PER_METRE)}, as in '{name} [mm]'"
        )
    return f"{quantity}_{unit}"


def _rows(
    path: Path, lines: Sequence[tuple[int, str]], delimiter: str, header: Sequence[str]
) -> list[tuple[str, int, list[str]]]:
    """Where each row stands in words, its line and its cells, as many as the header has."""
    rows = [
        (f"survey {path}, line {line}", line, next(csv.reader([text], delimiter=delimiter)))
        for line, text in lines
        if text.strip(f"{delimiter} \t")
    ]
    for where, _, row in rows:
        # A spreadsheet ends some rows with separators, or ends them early.
        while len(row) > len(header) and not row[-1].strip():
            row.pop()
        missing = header[len(row) :]
        # Between commas a row may be too short or too long by decimals that were split off.
        # Otherwise a row of one cell has other separators than the header.
        if not any(missing) if delimiter == "," else len(row) > 1 and _SINGLE.isdisjoint(missing):
            row += [""] * len(missing)
        # Decimals that are split off may fall into a last column without a name.
        names = len(header) - (delimiter == "," and header[-1] == "" and row[-1].strip().isdigit())
        if len(row) != names:
            raise SurveyError(f"{where}: {len(row)} cells, the header has {names} (is there a decimal comma?)")
    return rows


def _facts(comments: Iterable[str]) -> Iterator[tuple[str, str]]:
    """What comments say as ``name: text``; a spreadsheet fills their lines with separators."""
    for comment in comments:
        name, colon, text = comment.strip(' \t#";,').partition(":")
        name = MARK if name.strip().lower() == MARK else name
        if colon and (text.startswith(" ") or name == MARK):
            yield name, text.strip()


def _header(lines: Sequence[tuple[int, str]], own: Mapping[str, str]) -> tuple[int, str, list[str]]:
    """Index of the line after the first header with both columns, its delimiter and cells; units may have a line of
    their own below the names. If none has them, of the first line but Excel's own."""
    named = _SEPARATOR_LINE.fullmatch(lines[0][1].strip())
    first = 1 if named and len(lines) > 1 else 0
    delimiters = named[1] if named else _DELIMITERS
    for at in range(first, min(len(lines) - 1, _LINES_BEFORE)):
        for delimiter in delimiters:
            names, below = (next(csv.reader([text], delimiter=delimiter)) for _, text in (lines[at], lines[at + 1]))
            for size, cells in enumerate((names, map(" ".join, itertools.zip_longest(names, below, fillvalue=""))), 1):
                header = _cells(cells, own)
                if _complete(header):
                    return at + size, delimiter, header
    delimiter = next((mark for mark in delimiters if mark in lines[first][1]), ",")
    return first + 1, delimiter, _cells(next(csv.reader([lines[first][1]], delimiter=delimiter)), own)


def _complete(header: Sequence[str]) -> bool:
    """Whether the header has a column of x and one of deviation, or one for each run."""
    missing = [one for one in (X, DEVIATION) if not any(name in header for name in one.columns)]
    return not missing or (missing == [DEVIATION] and bool(_columns_of_runs(header)))


def _cells(names: Iterable[str], own: Mapping[str, str]) -> list[str]:
    """The cells of a header as they are compared: ``x_mm`` for ``X [mm]``, ``position (mm)``, or a name of ``own``.

    Where the column of a quantity is chosen by its own name, no other is meant.
    """
    chosen = {name.partition("_")[0] for name in own.values()}
    found = []
    for cell in names:
        name = _spelled(cell)
        first = _spelled(_NUMBERED.sub("", cell.strip()))
        quantity, _, unit = (first if first.startswith(("deviation_", "straightness_")) else name).rpartition("_")
        quantity = _SYNONYMS.get(quantity, quantity)
        usual = f"{quantity}_{unit}" if unit in PER_METRE else name
        other = f"({usual})" if unit in PER_METRE and quantity in chosen else usual
        of_run = "" if "deviation" in chosen else _of_run(cell)
        found.append(own.get(name) or of_run or other)
    return found


def _name_and_unit(name: str) -> tuple[str, str]:
    """What a column's name says before its unit, and the unit, empty where it does not end with a unit of length."""
    parts = _OWN_UNIT.fullmatch(_plain(name))
    return (parts[1], parts[2]) if parts and not _NO_LENGTH.search(parts[1]) else ("", "")


def _parts_of_run(name: str) -> tuple[str, list[str], list[str]]:
    """The unit of the column of a run, its directions, and its further parts but the words for a run; empty for a name
    that has neither a direction nor such a word, or no unit."""
    words, unit = _name_and_unit(name)
    words = re.sub(r"(?<=\d)[+-]$", lambda sign: _SIGNS[sign[0]], words)
    # A difference of runs, a mean or a deviation of them says so by a second number, a sign or a word.
    parts = re.findall(r"\d+|[^\W\d_]+|[^\s\w.#-]", words)
    if not unit or not {*DIRECTIONS, *_RUN_WORDS, *_VAGUE_WAYS}.intersection(parts):
        return "", [], []
    others = [part for part in parts if part not in {*DIRECTIONS, *_RUN_WORDS, "deviation", "straightness"}]
    return unit, [DIRECTIONS[part] for part in parts if part in DIRECTIONS], others


def _of_run(name: str) -> str:
    """``deviation_um (forward run 1)`` for ``Run 1 fwd [µm]``, the column of a run; empty for another name."""
    unit, ways, others = _parts_of_run(name)
    if not unit or len(ways) > 1 or len(others) > 1 or any(not one.isdigit() for one in others):
        return ""
    return f"deviation_{unit} ({' '.join([*ways, 'run', *others])})"


def _columns_of_runs(header: Sequence[str]) -> dict[int, tuple[str, str]]:
    """The column of deviation and the direction, empty where none is named, of each run that has a column of its own,
    by its place; empty for another file."""
    found = {at: (run[1], run[2] or "") for at, name in enumerate(header) if (run := _RUN.fullmatch(name))}
    alike = len({(unit, bool(way)) for unit, way in found.values()}) == 1
    other = {"run", "direction", *DEVIATION.columns}.intersection(header)
    return found if alike and not other else {}


def _unit_of_run(name: str) -> str | None:
    """The unit, empty if unknown, of a column that is a run by its number or direction or has no name; or None."""
    if (unit := _RUN.sub(lambda run: run[1].partition("_")[2], name).strip("[]()_ ")) in PER_METRE:
        return unit
    words, unit = _name_and_unit(name)
    words = re.sub(rf"(?<![a-z])(?:{'|'.join(_VAGUE_WAYS)})(?![a-z])", "", words or _UNKNOWN_UNIT.sub("", name))
    return unit if re.search(r"\d|ward", _of_run(f"{words} m")) else None


def _unit_of_vague(name: str) -> str:
    """The unit of a column among those of runs whose name does not exclude that it is one; empty for another."""
    unit, ways, others = _parts_of_run(name)
    numbers = [one for one in others if one.isdigit()]
    return "" if max(len(ways), len(numbers)) > 1 or _COMPUTED.intersection(others) else unit


def _check_columns_of_runs(
    where: str, header: Sequence[str], runs: Mapping[int, tuple[str, str]], rows: Sequence[tuple[str, int, list[str]]]
) -> None:
    """Raise SurveyError for two columns of one run, and for a column among those of ``runs`` that may be another run,
    or is one without a unit or a name: else it would be left out without a word."""
    first, (unit, _) = next(iter(runs.items()))
    for at, name in enumerate(header):
        if _RUN.fullmatch(name) and header.count(name) > 1:
            raise SurveyError(f"{where}: {name} is given twice; allowed: one column for each run, with its number")
        # Right of a name that was given to several cells in one; a total below the rows is no run.
        nameless = at > first and name.strip("[]()_ ") in ("", *PER_METRE)
        numbers = (re.fullmatch(r"[+-]?[\d.,]*\d", row[at].strip()) for *_, row in rows)
        nameless = nameless and sum(map(bool, numbers)) > 0.25 * len(rows)
        bare = _unit_of_run(name) == ""
        if nameless or bare or f"deviation_{_unit_of_vague(name)}" == unit:
            lack = " and has no name" if nameless else f" and has no unit of {', '.join(PER_METRE)}" if bare else ""
            raise SurveyError(
                f"{where}: column '{at + 1 if nameless else name}' may be a run{lack}; allowed for a run: a name such "
                f"as 'Run 1 forward [µm]' or 'Run 1- [µm]'; for a figure of runs: {', '.join(sorted(_COMPUTED))}"
            )


def _check_other_x(
    where: str, header: Sequence[str], x: int, runs: Iterable[int], rows: Sequence[tuple[str, int, list[str]]]
) -> None:
    """Raise SurveyError for a column that is as long as that of ``x``, has other positions, and is of some of the
    ``runs``: these would be read at ``x``, turned round if they were listed as they were driven."""
    for at, name in enumerate(header):
        _, unit = _name_and_unit(_NUMBERED.sub("", name))
        # One x for all runs, as of the machine, stands with the first x, or all runs stand between the two.
        between = {min(x, at) < run < max(x, at) for run in runs}
        if not (unit and _OF_X.search(name) and (len(between) > 1 or DIRECTIONS.keys() & re.findall("[a-z]+", name))):
            continue
        both = ([number_or_nan(row[one].replace(",", ".")) for one in (x, at)] for *_, row in rows)
        pairs = [pair for pair in both if all(map(math.isfinite, pair))] or [[0.0, 0.0]]
        length, other = (max(column) - min(column) for column in zip(*pairs, strict=True))
        if 0.5 * length < other < 2.0 * length and max(abs(a - b) for a, b in pairs) > 0.5 * length / (len(pairs) - 1):
            raise SurveyError(
                f"{where}: {name} (column {at + 1}) has other positions than {header[x]}; allowed: one x for all runs; "
                "write runs at positions of their own one below the other, or choose x by --x-column"
            )


def _a_row_for_each(
    runs: Mapping[int, tuple[str, str]], header: Sequence[str], rows: Sequence[tuple[str, int, list[str]]]
) -> tuple[list[str], list[tuple[str, int, list[str]]]]:
    """Header and rows with one column of deviation in place of one for each of ``runs``; an empty cell is no point."""
    shared = [at for at in range(len(header)) if at not in runs]
    found = [
        (where, line, [*(row[at] for at in shared), f"column {at + 1}", way, row[at]])
        for where, line, row in rows
        for at, (_, way) in runs.items()
        if row[at].strip()
    ]
    unit, way = next(iter(runs.values()))
    return [*(header[at] for at in shared), RUN_COLUMN, "direction" if way else "", unit], found


def _with_run(header: list[str], rows: Sequence[Row]) -> list[str]:
    """The header, and the cells, with a column ``run`` for one such as ``Run No.`` or ``Cycle``, if the runs take turns
    in it: without it, they would be one run with points as close as x scatters. Else x says where runs begin."""
    for name in header:
        if _NUMBER_OF_RUN.match(name) and not {"run", RUN_COLUMN}.intersection(header):
            cells = [row.cells[name] for row in rows]
            if 10 * len({*cells}) < len(rows) < 10 * sum(1 for _ in itertools.groupby(cells)):
                for row, cell in zip(rows, cells, strict=True):
                    row.cells["run"] = cell
                return [*header, "run"]
    return header


def _with_direction(where: str, header: list[str], rows: Sequence[Row]) -> list[str]:
    """The header, and the cells, with the name ``direction`` for the first column that has a direction in each row, and
    both in all, if x goes the same way in both: else these would be taken for runs of one direction. A column ``run``
    that has more in its cells keeps its name too. SurveyError for other words in a column of directions.

    Where x turns, its trend is the direction: an instrument may call the way on which x falls forward, or the column
    may say how a single point was approached.
    """
    for at, name in enumerate(header):
        of_directions = _OF_DIRECTIONS.search(name)
        words = WAYS_IN_CELLS if of_directions else DIRECTIONS
        # Of a column of numbers one cell is enough.
        if not (of_directions or any(_way(row.cells[name], words) for row in rows[:1])):
            continue
        cells = [row.cells[name].lower() for row in rows]
        ways = {cell: _way(cell, words) for cell in dict.fromkeys(cells)}
        known = {*ways.values()} == {*WAYS}
        passages: dict[str, list[float]] = {}
        # A spreadsheet leaves the cells below the first of a run empty.
        filled: Iterator[str] = itertools.accumulate(cells, lambda last, cell: cell or last)
        for row, cell in zip(rows, filled, strict=True):
            passages.setdefault(ways[cell] or cell, []).append(row.x)
        trends = [sum((b > a) - (b < a) for a, b in itertools.pairwise(x)) for x in passages.values()]
        lows, highs = ([of(x) for x in passages.values()] for of in (min, max))
        shared = len(passages) > 1 and min(highs) - max(lows) > (max(highs) - min(lows)) / 2.0
        if not (known or of_directions) or not shared or min(trends) * max(trends) <= 0:
            continue
        if not known:
            raise SurveyError(
                f"{where}: column '{name}' says {' and '.join(map(repr, [*ways][:2]))} where x goes the same way; "
                f"allowed in each row: {ALLOWED_WAYS}"
            )
        kept = name == "run" and len(ways) > len(WAYS)
        for row, cell in zip(rows, cells, strict=True):
            row.cells["direction"] = ways[cell] or ""
            if not kept:
                del row.cells[name]
        return [*header, "direction"] if kept else [*header[:at], "direction", *header[at + 1 :]]
    return header


def _way(cell: str, words: Mapping[str, Direction]) -> str | None:
    """The direction that a cell says by one of ``words``, or as the name of a run (``1 forward``, ``Run 2-``)."""
    run = _RUN.fullmatch(_of_run(f"{cell} m"))
    return words.get(cell.lower()) or (run[2] if run else None)


def _spelled(name: str) -> str:
    """``position_mm`` for ``Position [mm]``; a name of another form in lower case."""
    parts = _NAME_AND_UNIT.fullmatch(_plain(name))
    # Without a sign between them "xm" would be x in m; such a name is left as it is.
    return f"{parts[1]}_{parts[2]}" if parts and parts.end(1) != parts.start(2) else _plain(name)


def _plain(cell: str) -> str:
    """In lower case, with either micro sign as ``u``, inches as ``in``, and a unit last that is before a direction
    or a number; what is too long for a name ends with …"""
    text = cell.strip().lower()
    text = text if len(text) <= _LONGEST_NAME else f"{text[:_LONGEST_NAME]}…"
    text = text.replace("\u00b5", "u").replace("\u03bc", "u").replace("\u2212", "-")
    text = _INCH.sub(lambda found: "uin" if found[1] else "in", text)
    return _UNIT_WITHIN.sub(r"\1\3 \4 \2", text).strip()


def _use_points(rows: Sequence[tuple[str, int, list[str]]], columns: Sequence[int], delimiter: str) -> None:
    """Make points of decimal commas, and leave the marks out that separate thousands."""
    cells = [(where, row, column, row[column].strip()) for where, _, row in rows for column in columns]
    texts = [cell for *_, cell in cells]
    marks = {mark for mark in ".," if any(mark in cell for cell in texts)}
    decimal = {max(".,", key=cell.rfind) for cell in texts if "." in cell and "," in cell}
    decimal = decimal or {
        mark for mark in marks if any(mark in cell and not _GROUPED.fullmatch(cell) for cell in texts)
    }
    # A mark that a number has twice separates thousands.
    decimal = decimal or {".,"[mark == "."] for mark in marks if any(cell.count(mark) > 1 for cell in texts)}
    if len(marks) == 2 and len(decimal) != 1:
        where = next(where for where, *_, cell in cells if "," in cell)
        raise SurveyError(
            f"{where}: the numbers have points and commas, and either may be the decimal mark; "
            "allowed: one decimal mark, and thousands without any"
        )
    for column in columns if len(marks) == 1 and not decimal else ():
        # 890 and 1.242 in one column: a number of a thousand and more has a mark, or a whole number has none.
        # "1,242" between commas: thousands in English, or decimals in German.
        marked = next((one for one in cells if one[2] == column and _GROUPED.fullmatch(one[3])), None)
        if marked and (delimiter == "," or any(at == column and _WHOLE.fullmatch(cell) for _, _, at, cell in cells)):
            raise SurveyError(
                f"{marked[0]}: {marked[3]!r}: its mark may be a decimal mark, or separate thousands; allowed: "
                "thousands without any mark, or decimals in every number, as in 312.0"
            )
    point = "".join(decimal or marks)
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
