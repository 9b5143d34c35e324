"""A table of measured points as people and instruments write it: its encoding, its separators and decimal marks.

Semicolons or tabs may stand between the cells, and then decimal commas; lines before the header, and Excel's ``sep=``.
`survey_header.py` says what a column is by its name.
"""

import csv
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from straightcomp_ros.parameters.yaml_text import bounded_bytes, marked_encoding, number_or_nan
from straightcomp_ros.straightness.survey_header import (
    COMPUTED,
    DEVIATION,
    DIRECTIONS,
    PER_METRE,
    TIME_COLUMN,
    WAYS,
    Chosen,
    Column,
    Direction,
    SurveyError,
    X,
    chosen_columns,
    column_named,
    column_of,
    columns,
    is_complete,
    runs_of,
)

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
        raise SurveyError(f"survey {path}: byte {failed.start} is not UTF-8; {_SAVE_IT}") from failed
    if "\0" in text:
        raise SurveyError(f"survey {path}: character {text.index(chr(0))} is NUL; {_SAVE_IT}")
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


WAYS_IN_CELLS: dict[str, Direction] = {
    **DIRECTIONS,
    **dict.fromkeys(["f", "+", "1", "+1", "1.0"], "forward"),
    **dict.fromkeys(["b", "r", "-", "\u2212", "-1", "\u22121", "-1.0"], "backward"),
}
"""What a cell of the column of directions may say too."""
ALLOWED_WAYS = "forward or backward, fwd or bwd, reverse or rev, f or b, r, + or -, 1 or -1"
_OF_DIRECTIONS = re.compile(r"(?<![a-z])dir(?:ection)?s?(?![a-z])|(?<!vor)richtung|(?<![a-z])sens(?: d|$)")
"""What is in the name of a column of directions."""
_NUMBER_OF_RUN = re.compile(r"(?:run|cycle)(?:[\s_]*(?:#|n[or]\b.?|number))?$")
"""What the column of the runs' names may be called too."""
RUN_COLUMN = "column of the run"
"""Name of the cell that says which column a point is from."""
_SINGLE = ("run", "direction", TIME_COLUMN)
"""Names of columns that a file has once."""
_DELIMITERS = "\t;,"
_SEPARATOR_LINE = re.compile(r"sep=(.)", re.IGNORECASE)
"""Excel's own first line, which names the delimiter."""
_SAVE_IT = "save it as UTF-8 text, a spreadsheet as CSV"
_LONGEST_LINE = 100_000
"""Characters; the csv module reads cells of some more."""
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
    chosen = chosen_columns(path, names or {})
    first, delimiter, header = _header(lines, chosen)
    if not is_complete(header):
        # Programs that write numbers write the header as a comment.
        head = [(line, text.strip(' \t"#')) for line, text in every if _COMMENT.match(text) and line < lines[0][0]]
        at_head, mark, names_there = _header([*head, *lines], chosen)
        if is_complete(names_there):
            lines, first, delimiter, header = [*head[:at_head], *lines], at_head, mark, names_there
    runs = {} if DEVIATION.name in chosen else runs_of(header)
    try:
        header_line = f"survey {path}, line {lines[first - 1][0]}"
        at_x = column_of(X, header_line, header)
        deviation = next(iter(runs.values())) if runs else header[column_of(DEVIATION, header_line, header)]
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
    x, names_of = header[at_x], [one.name for one in header]
    known = runs or DEVIATION.name in chosen or {"run", "direction"} <= {*names_of}
    of_runs = [one for one in header if one.seems_run and (one.unit != x.unit or x.unit == deviation.unit)]
    # The mean of one direction is no deviation: that is the other one.
    if not known and (len(of_runs) > 1 or any(one.is_run and one.ways for one in of_runs)):
        raise SurveyError(
            f"{header_line}: {deviation.name} stands among columns of runs; remove it, or choose it by "
            "--deviation-column"
        )
    for name in _SINGLE:
        if names_of.count(name) > 1:
            raise SurveyError(f"{header_line}: {name} is given twice; allowed: one column of this name")
    rows = _rows(path, lines[first:], delimiter, header)
    if runs:
        _check_columns_of_runs(header_line, header, runs, rows)
        if X.name not in chosen:
            _check_other_x(header_line, header, at_x, runs, rows)
        names_of, rows = _a_row_for_each(runs, names_of, rows)
    quantities = x.name, f"{DEVIATION.name}_{deviation.unit}"
    numbers = [at for at, name in enumerate(names_of) if name in (*quantities, TIME_COLUMN)]
    for _, _, row in rows:
        for at in numbers:
            row[at] = _SPACED.sub("", row[at]).replace("\u2212", "-")
    # Between commas a point is the decimal mark, unless a comma stands in a number, in quotes.
    if delimiter != "," or any("," in row[at] for _, _, row in rows for at in numbers):
        _use_points(rows, numbers, delimiter)
    found = []
    for where, line, row in rows:
        cells = dict(zip(names_of, map(str.strip, row), strict=True))
        # Division keeps a decimal number the nearest float.
        found.append(
            Row(
                line,
                cells,
                *(
                    number(where, name, cells[name]) / PER_METRE[one.unit]
                    for name, one in zip(quantities, (x, deviation), strict=True)
                ),
            )
        )
    # A recording over time may have a counter or a sign of the speed in each row.
    if TIME_COLUMN not in names_of:
        names_of = _with_run(names_of, found)
        names_of = names_of if "direction" in names_of else _with_direction(header_line, names_of, found)
    return Table(names_of, quantities, found, dict(_facts(text for _, text in every if _COMMENT.match(text))))


def _rows(
    path: Path, lines: Sequence[tuple[int, str]], delimiter: str, header: Sequence[Column]
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
        needed = any(one.quantity or one.name in _SINGLE for one in missing)
        # Between commas a row may be too short or too long by decimals that were split off.
        # Otherwise a row of one cell has other separators than the header.
        if not any(one.name for one in missing) if delimiter == "," else len(row) > 1 and not needed:
            row += [""] * len(missing)
        # Decimals that are split off may fall into a last column without a name.
        names = len(header) - (delimiter == "," and header[-1].name == "" and row[-1].strip().isdigit())
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


def _header(lines: Sequence[tuple[int, str]], chosen: Chosen) -> tuple[int, str, list[Column]]:
    """Index of the line after the first header with both columns, its delimiter and cells; units may have a line of
    their own below the names. If none has them, of the first line but Excel's own."""
    named = _SEPARATOR_LINE.fullmatch(lines[0][1].strip())
    first = 1 if named and len(lines) > 1 else 0
    delimiters = named[1] if named else _DELIMITERS
    for at in range(first, min(len(lines) - 1, _LINES_BEFORE)):
        for delimiter in delimiters:
            names, below = (next(csv.reader([text], delimiter=delimiter)) for _, text in (lines[at], lines[at + 1]))
            for size, cells in enumerate((names, map(" ".join, itertools.zip_longest(names, below, fillvalue=""))), 1):
                header = columns(cells, chosen)
                if is_complete(header):
                    return at + size, delimiter, header
    delimiter = next((mark for mark in delimiters if mark in lines[first][1]), ",")
    return first + 1, delimiter, columns(next(csv.reader([lines[first][1]], delimiter=delimiter)), chosen)


def _check_columns_of_runs(
    where: str, header: Sequence[Column], runs: Mapping[int, Column], rows: Sequence[tuple[str, int, list[str]]]
) -> None:
    """Raise SurveyError for two columns of one run, and for a column among those of ``runs`` that may be another run,
    or is one without a unit or a name: else it would be left out without a word."""
    first, run = next(iter(runs.items()))
    named = [one.run for one in runs.values()]
    for one in runs.values():
        if named.count(one.run) > 1:
            raise SurveyError(f"{where}: {one.name} is given twice; allowed: one column for each run, with its number")
    for at, one in enumerate(header):
        # Right of a name that was given to several cells in one; a total below the rows is no run.
        numbers = (re.fullmatch(r"[+-]?[\d.,]*\d", row[at].strip()) for *_, row in rows)
        nameless = at > first and not one.words and sum(map(bool, numbers)) > 0.25 * len(rows)
        bare = one.seems_run and not one.unit
        if nameless or bare or (one.may_be_run and not one.is_run and one.unit == run.unit):
            lack = " and has no name" if nameless else f" and has no unit of {', '.join(PER_METRE)}" if bare else ""
            raise SurveyError(
                f"{where}: column '{at + 1 if nameless else one.name}' may be a run{lack}; allowed for a run: a name "
                f"such as 'Run 1 forward [µm]' or 'Run 1- [µm]'; for a figure of runs: {', '.join(sorted(COMPUTED))}"
            )


def _check_other_x(
    where: str, header: Sequence[Column], x: int, runs: Iterable[int], rows: Sequence[tuple[str, int, list[str]]]
) -> None:
    """Raise SurveyError for a column that is as long as that of ``x``, has other positions, and is of some of the
    ``runs``: these would be read at ``x``, turned round if they were listed as they were driven."""
    for at, one in enumerate(header):
        # One x for all runs, as of the machine, stands with the first x, or all runs stand between the two.
        of_some = len({min(x, at) < run < max(x, at) for run in runs}) > 1 or one.ways
        if at == x or not (one.unit and {X.name, *X.synonyms}.intersection(one.words) and of_some):
            continue
        both = ([number_or_nan(row[place].replace(",", ".")) for place in (x, at)] for *_, row in rows)
        pairs = [pair for pair in both if all(map(math.isfinite, pair))] or [[0.0, 0.0]]
        length, other = (max(column) - min(column) for column in zip(*pairs, strict=True))
        if 0.5 * length < other < 2.0 * length and max(abs(a - b) for a, b in pairs) > 0.5 * length / (len(pairs) - 1):
            raise SurveyError(
                f"{where}: {one.name} (column {at + 1}) has other positions than {header[x].name}; allowed: one x for "
                "all runs; write runs at positions of their own one below the other, or choose x by --x-column"
            )


def _a_row_for_each(
    runs: Mapping[int, Column], header: Sequence[str], rows: Sequence[tuple[str, int, list[str]]]
) -> tuple[list[str], list[tuple[str, int, list[str]]]]:
    """Names and rows with one column of deviation in place of one for each of ``runs``; an empty cell is no point."""
    shared = [at for at in range(len(header)) if at not in runs]
    found = [
        (where, line, [*(row[at] for at in shared), f"column {at + 1}", *run.ways, row[at]])
        for where, line, row in rows
        for at, run in runs.items()
        if row[at].strip()
    ]
    run = next(iter(runs.values()))
    directions = ["direction"] if run.ways else []
    return [*(header[at] for at in shared), RUN_COLUMN, *directions, f"{DEVIATION.name}_{run.unit}"], found


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
    run = column_named(f"{cell} m")
    return words.get(cell.lower()) or (next(iter(run.ways), None) if run.is_run else None)


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
