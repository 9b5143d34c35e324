"""What was learned, as a CSV file: one line for each node of x, forward and backward side by side."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.learned_table import LearnedTable
from straightcomp_ros.settings.declaration import ParameterError

_QUANTITIES = ("correction_m", "speed_m_per_s", "rms_m", "bare_rms_m")
_DIRECTIONS = (("forward", True), ("backward", False))
_HEADER = ("x_m", *(f"{direction}_{quantity}" for direction, _ in _DIRECTIONS for quantity in _QUANTITIES))
_LAW = "# law:"
_LARGEST = 1e-3
"""m; beyond it the unit is wrong."""


class LearningFileError(ParameterError):
    """A file of what was learned cannot be used; the message names file, line, value and what is allowed."""


def write_tables(path: Path, law: str, tables: Mapping[bool, LearnedTable]) -> None:
    """Write the best that was learned, replacing ``path`` in one step: a stop in between leaves the old file.

    Args:
        path: the file.
        law: name of the law that it was learned with.
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
        columns += [
            np.pad(table.best, around),
            np.pad(table.speed, around),
            np.sqrt(np.pad(table.best_square, around, constant_values=math.nan)),
            np.sqrt(np.pad(table.bare_square, around, constant_values=math.nan)),
        ]
    lines = [
        "# Correction of the reference learned by straightcomp, as coefficients of a uniform cubic B-spline over x.",
        "# rms: of r - y in the best pass; bare_rms: without a correction; empty where nothing was learned.",
        f"{_LAW} {law}",
        ",".join(_HEADER),
    ]
    for node, row in zip(range(first, last), np.column_stack(columns).tolist(), strict=True):
        cells = ("" if math.isnan(value) else f"{value:.6g}" for value in row)
        lines.append(f"{node * spacing:.9g}," + ",".join(cells))
    beside = path.with_name(path.name + ".part")
    beside.write_text("\n".join(lines) + "\n", encoding="utf-8")
    os.replace(beside, path)


def read_tables(path: Path, law: str, tables: Mapping[bool, LearnedTable]) -> None:
    """Read what :func:`write_tables` wrote into ``tables``, for the law named ``law``.

    Raises:
        LearningFileError: the file cannot be read, was learned with another law or spacing, or is damaged.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise LearningFileError(f"learning file {path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise LearningFileError(f"learning file {path}: byte {error.start} is not UTF-8") from error
    learned_with = next((line[len(_LAW) :].strip() for line in lines if line.startswith(_LAW)), None)
    if learned_with != law:
        said = "names no law" if learned_with is None else f"was learned with law '{learned_with}'"
        raise LearningFileError(f"learning file {path}: {said}; allowed: '{_LAW} {law}', the law that runs")
    rows = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not rows or tuple(next(csv.reader([rows[0][1]]))) != _HEADER:
        found = rows[0][1] if rows else ""
        raise LearningFileError(f"learning file {path}: header {found!r}; allowed: {','.join(_HEADER)!r}")
    numbers = np.array([_numbers(path, number, line) for number, line in rows[1:]]).reshape(-1, len(_HEADER))
    if not len(numbers):
        raise LearningFileError(f"learning file {path}: has a header but no rows; allowed: at least one")
    first = _first_node(path, rows, numbers[:, 0], tables[True].spacing)
    for index, (_, forward) in enumerate(_DIRECTIONS):
        correction, speed, rms, bare_rms = numbers[:, 1 + 4 * index : 5 + 4 * index].T
        tables[forward].restore(first, correction, rms * rms, bare_rms * bare_rms, speed)


def _first_node(path: Path, rows: list[tuple[int, str]], x: NDArray[np.float64], spacing: float) -> int:
    first = round(float(x[0]) / spacing)
    wrong = np.flatnonzero(np.abs(x - (first + np.arange(x.size)) * spacing) > 1e-3 * spacing)
    if wrong.size:
        at = int(wrong[0])
        raise LearningFileError(
            f"learning file {path}, line {rows[1 + at][0]}: x_m {float(x[at]):.9g}; allowed: "
            f"{(first + at) * spacing:.9g}, nodes {spacing:g} m apart without a gap (learning.spacing)"
        )
    return first


def _numbers(path: Path, number: int, line: str) -> list[float]:
    cells = next(csv.reader([line]))
    if len(cells) != len(_HEADER):
        raise LearningFileError(
            f"learning file {path}, line {number}: {len(cells)} cells; allowed: {len(_HEADER)}, as the header has"
        )
    values = []
    for name, cell in zip(_HEADER, cells, strict=True):
        unknown = name.endswith("rms_m") and not cell
        try:
            value = math.nan if unknown else float(cell)
        except ValueError:
            raise LearningFileError(
                f"learning file {path}, line {number}: {name} {cell!r}; allowed: a number"
            ) from None
        largest = math.inf if name == "x_m" or "speed" in name else _LARGEST
        if not unknown and not (math.isfinite(value) and abs(value) <= largest):
            words = "a finite number" if largest == math.inf else f"a number within ± {largest:g} m"
            raise LearningFileError(f"learning file {path}, line {number}: {name} {cell!r}; allowed: {words}")
        values.append(value)
    return values
