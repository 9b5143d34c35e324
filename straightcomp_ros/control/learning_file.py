"""The learned tables as a CSV file: one line for each node of x, forward and backward side by side."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from straightcomp_ros.control.learned_table import LearnedTable
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.output_files import write_whole

_QUANTITIES = ("correction_m", "speed_m_per_s", "rms_m", "bare_rms_m")
_DIRECTIONS = (("forward", True), ("backward", False))
_HEADER = ("x_m", *(f"{direction}_{quantity}" for direction, _ in _DIRECTIONS for quantity in _QUANTITIES))
_LAW = "# law:"
_LARGEST = 1e-3
"""m; a larger value is in the wrong unit."""


class LearningFileError(ParameterError):
    """A learning file is refused; the message names file, line, value and what is allowed."""


def write_tables(path: Path, law: str, tables: Mapping[bool, LearnedTable]) -> None:
    """Write the best tables, replacing ``path`` in one step: an interruption leaves the old file. Writes no empty file.

    Args:
        path: the file.
        law: name of the law that was corrected.
        tables: forward at True, backward at False, of the same spacing.

    Raises:
        OSError: it cannot be written.
    """
    spacing = tables[True].spacing
    filled = [table for table in tables.values() if table.best.size]
    if not filled:
        return
    first = min(table.first for table in filled)
    last = max(table.first + table.best.size for table in filled)
    columns = []
    for _, forward in _DIRECTIONS:
        table = tables[forward]
        around = (table.first - first, last - table.first - table.best.size) if table.best.size else (last - first, 0)
        columns += [np.pad(values, around) for values in (table.best, table.speed)]
        for squares in (table.best_square, table.bare_square):
            columns.append(np.sqrt(np.pad(squares, around, constant_values=math.nan)))
    lines = [
        "# Correction of the reference learned by straightcomp, as coefficients of a uniform cubic B-spline over x.",
        "# rms: of r - y in the best pass; bare_rms: without a correction; empty where nothing was learned.",
        f"{_LAW} {law}",
        ",".join(_HEADER),
    ]
    for node, row in zip(range(first, last), np.column_stack(columns).tolist(), strict=True):
        cells = ("" if math.isnan(value) else f"{value:.6g}" for value in row)
        lines.append(f"{node * spacing:.9g}," + ",".join(cells))
    write_whole(path, "\n".join(lines) + "\n")


def read_tables(path: Path, law: str, tables: Mapping[bool, LearnedTable]) -> None:
    """Read what :func:`write_tables` wrote into ``tables``, for the law named ``law``.

    Raises:
        LearningFileError: the file cannot be read, was learned with another law or spacing, or is damaged.
    """
    file = f"learning file {path}"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise LearningFileError(f"{file}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise LearningFileError(f"{file}: byte {error.start} is not UTF-8") from error
    learned_with = next((line[len(_LAW) :].strip() for line in lines if line.startswith(_LAW)), None)
    if learned_with != law:
        said = "names no law" if learned_with is None else f"was learned with law '{learned_with}'"
        raise LearningFileError(f"{file}: {said}; allowed: '{_LAW} {law}', the law that runs")
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    (_, header), *rows = numbered or [(0, "")]
    if tuple(next(csv.reader([header]), ())) != _HEADER:
        raise LearningFileError(f"{file}: header {header!r}; allowed: {','.join(_HEADER)!r}")
    if not rows:
        raise LearningFileError(f"{file}: has a header but no rows; allowed: at least one")
    numbers = np.array([_numbers(f"{file}, line {number}", line) for number, line in rows])
    x, spacing = numbers[:, 0], tables[True].spacing
    first = round(float(x[0]) / spacing)
    wrong = np.flatnonzero(np.abs(x - (first + np.arange(x.size)) * spacing) > 1e-3 * spacing)
    if wrong.size:
        at = int(wrong[0])
        raise LearningFileError(
            f"{file}, line {rows[at][0]}: x_m {float(x[at]):.9g}; allowed: {(first + at) * spacing:.9g}, "
            f"nodes {spacing:g} m apart without a gap (learning.spacing)"
        )
    for index, (_, forward) in enumerate(_DIRECTIONS):
        correction, speed, rms, bare_rms = numbers[:, 1 + 4 * index : 5 + 4 * index].T
        tables[forward].restore(first, correction, rms * rms, bare_rms * bare_rms, speed)


def _numbers(where: str, line: str) -> list[float]:
    cells = next(csv.reader([line]))
    if len(cells) != len(_HEADER):
        raise LearningFileError(f"{where}: {len(cells)} cells; allowed: {len(_HEADER)}, as the header has")
    return [_number(where, name, cell) for name, cell in zip(_HEADER, cells, strict=True)]


def _number(where: str, name: str, cell: str) -> float:
    if name.endswith("rms_m") and not cell:
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    largest = math.inf if name == "x_m" or "speed" in name else _LARGEST
    if not (math.isfinite(value) and abs(value) <= largest):
        words = "a finite number" if largest == math.inf else f"a number within ± {largest:g} m"
        raise LearningFileError(f"{where}: {name} {cell!r}; allowed: {words}")
    return value
