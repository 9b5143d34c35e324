"""Aerotech's two-dimensional axis calibration file (``.cal``) of A3200 and Automation1, used for one cross-axis error.

    ; RowAxis ColumnAxis OutputAxis1 OutputAxis2 SampDistRow SampDistCol NumCols
    :START2D 2 1 2 1 1 10 177
    :START2D POSUNIT=PRIMARY CORUNIT=PRIMARY/1000 OFFSETROW=0 OFFSETCOL=0
    3.796 0  3.12 0  …
    :END

Described in Aerotech's Automation1 help, "Axis Calibration": axes count from 1, values between two points are
interpolated linearly, beyond the ends the last value holds, and each value is added to the position of its output axis.
Keywords and their order are as public programs write them that make such files for A3200 and Automation1. Column i
stands at i · SampDistCol − OFFSETCOL. A negative distance counts from the home of the axis, which the file does not
contain, and is refused. The correction is the same whatever the direction ("Axis Calibration"): a map with a table for
each direction is written as their mean. Here the two rows are the same: the correction does not depend on the row axis.
"""

import re
from pathlib import Path

import numpy as np

from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.straightness.survey_table import decimal, number, numbered_lines
from straightcomp_ros.tuning.survey.error_table import UNITS, Conventions, Points, survey_of

_HEAD = ("RowAxis", "ColumnAxis", "OutputAxis1", "OutputAxis2", "SampDistRow", "SampDistCol", "NumCols")
_KEYWORD = re.compile(r"([A-Z0-9]+)\s*=\s*(\S+)")
_SAME = 1e-9
"""Rows may differ by this much, in m, and the x of one point in two tables."""


def read(path: Path, conventions: Conventions) -> Survey:
    """Read the sum of the tables that correct ``conventions.platform_axis`` over ``conventions.stage_axis``, which may
    be the axis of their columns or of their rows: "axis calibration is additive" (Automation1 help). Between two points
    each is linear, and beyond its ends the last value.

    Raises:
        SurveyError: no such table, a head or value that is not understood, or a correction that also depends on
            the other axis.
    """
    stage, platform = conventions.stage_axis, conventions.platform_axis
    found, ours = [], []
    for start, head, values in _tables(path):
        where = f"survey {path}, line {start}"
        row_axis, column_axis, *outputs, row_step, column_step, columns = _positions(where, head)
        keywords = {key: value for line in head for key, value in _KEYWORD.findall(line)}
        if "OUTAXIS3" in keywords:
            outputs.append(number(where, "OUTAXIS3", keywords["OUTAXIS3"]))
        found += [f"{output:g} over {row_axis:g} and {column_axis:g}" for output in outputs]
        if platform not in outputs or stage not in (row_axis, column_axis):
            continue
        if row_axis == column_axis:
            raise SurveyError(f"{where}: rows and columns are both of axis {row_axis:g}; allowed: two axes")
        if not values or columns < 2 or len(values) % (int(columns) * len(outputs)):
            raise SurveyError(
                f"{where}: {len(values)} values; allowed: rows of NumCols × outputs = {columns:g} × {len(outputs)}"
            )
        cells = np.array(values).reshape(-1, int(columns), len(outputs))
        grid = cells[:, :, [output == platform for output in outputs]].sum(axis=2)
        grid = grid / _per_metre(where, keywords.get("CORUNIT", "PRIMARY"), conventions)
        name, other, step = "Col", "row", column_step
        if row_axis == stage:
            name, other, step, grid = "Row", "column", row_step, grid.T
        if float(np.ptp(grid, axis=0).max()) > _SAME:
            raise SurveyError(
                f"{where}: the correction depends on the {other} axis too; allowed: {other}s that are the same"
            )
        if step <= 0.0:
            raise SurveyError(f"{where}: SampDist{name} {step:g}; allowed: > 0; write the points in the other order")
        offset = number(where, f"OFFSET{name.upper()}", keywords.get(f"OFFSET{name.upper()}", "0"))
        units = _per_metre(where, keywords.get("POSUNIT", "PRIMARY"), conventions)
        sign = 1.0 if any("NEGCOR" in line for line in head) else -1.0
        ours.append(((np.arange(grid.shape[1]) * step - offset) / units, sign * grid[0]))
    if not ours:
        raise SurveyError(
            f"survey {path}: no :START2D table corrects axis {platform} (platform) over axis {stage} (stage); found: "
            f"{', '.join(found) or 'none'}"
        )
    every = np.unique(np.concatenate([x for x, _ in ours]))
    every = every[np.append(True, np.diff(every) > _SAME)]
    total = np.sum([np.interp(every, *table) for table in ours], axis=0)
    return survey_of(f"survey {path}", zip(every.tolist(), total.tolist(), strict=True))


def write(points: Points, conventions: Conventions) -> str:
    """A file with one table; the positions must be equally spaced."""
    x, deviation = np.array(points).T
    spacing = float(np.diff(x).mean())
    per_metre = conventions.per_metre
    stage, platform = conventions.stage_axis, conventions.platform_axis
    places, fine = conventions.places(1e-8), conventions.places(1e-12)
    offset = decimal(-float(x[0]) * per_metre, fine)
    row = "  ".join(f"{decimal(value * per_metre * 1e3, places)} 0" for value in (-deviation).tolist())
    return f"""; Correction of axis {platform} over axis {stage}, the same for every position of axis {platform}.
; {" ".join(_HEAD)}
:START2D {platform} {stage} {platform} {stage} 1 {decimal(spacing * per_metre, fine)} {len(x)}
:START2D POSUNIT=PRIMARY CORUNIT=PRIMARY/1000 OFFSETROW=0 OFFSETCOL={offset}
{row}
{row}
:END
"""


def _tables(path: Path) -> list[tuple[int, list[str], list[float]]]:
    """Line number of the start, head lines in capitals and values of each table."""
    tables: list[tuple[int, list[str], list[float]]] = []
    inside = False
    for line, raw in numbered_lines(path, r"[;'].*|^\s*\*.*"):
        where = f"survey {path}, line {line}"
        text = raw.strip()
        upper = text.upper()
        if upper.startswith(":START2D"):
            if not inside or tables[-1][2]:
                tables.append((line, [], []))
            tables[-1][1].append(upper[len(":START2D") :])
            inside = True
        elif upper.startswith(":START"):
            raise SurveyError(f"{where}: a :START table corrects an axis along itself; allowed: :START2D")
        elif upper.startswith(":END"):
            inside = False
        elif not inside:
            raise SurveyError(f"{where}: {text[:20]!r} is outside of a table; allowed: after :START2D")
        else:
            tables[-1][2].extend(number(where, "correction", cell) for cell in text.split())
    if inside:
        raise SurveyError(f"survey {path}: ends without :END; is it cut off?")
    return tables


def _positions(where: str, head: list[str]) -> list[float]:
    """The seven numbers of the head, which stand on the line without keywords."""
    for line in head:
        cells = _KEYWORD.sub("", line).replace("NEGCOR", "").split()
        if len(cells) == len(_HEAD):
            return [number(where, name, cell) for name, cell in zip(_HEAD, cells, strict=True)]
    raise SurveyError(f"{where}: no line with {len(_HEAD)} numbers; allowed: {' '.join(_HEAD)}")


def _per_metre(where: str, text: str, conventions: Conventions) -> float:
    """Units of ``PRIMARY``, ``METRIC`` or ``ENGLISH``, with or without a divisor, in a metre."""
    name, _, divisor = text.partition("/")
    known = {"PRIMARY": conventions.per_metre, "METRIC": UNITS["mm"], "ENGLISH": UNITS["inch"]}
    if name not in known:
        raise SurveyError(f"{where}: unit {text!r}; allowed: {', '.join(known)}, each also with a divisor as in /1000")
    by = number(where, "divisor of the unit", divisor or "1")
    if by <= 0.0:
        raise SurveyError(f"{where}: unit {text!r}; allowed: a divisor > 0")
    return known[name] * by
