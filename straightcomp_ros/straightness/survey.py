"""The survey file: the measured deviation of the guide, as CSV.

    # any comment
    run,direction,x_mm,deviation_um
    1,forward,0,-3.796
    1,forward,10,-3.12

The unit stands in the column's name: x in m, mm or um, deviation in m, mm, um or nm. Instruments and
spreadsheets write it otherwise: ``Position (mm)``, ``Straightness [µm]`` and cells separated by semicolon or
tab, then also with decimal commas, are read as well. ``run`` and
``direction`` may be left out: then the file is one run, and the trend of x tells its direction. Rows
belong to one run if run and direction are the same, so that a cycle may count forward and backward
as one. Other columns are ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np

from straightcomp_ros.straightness.csv_rows import metres, rows
from straightcomp_ros.straightness.survey_columns import DEVIATION, SurveyError, X, find_column, normalised
from straightcomp_ros.straightness.survey_run import Direction, Run, check_gaps, orient
from straightcomp_ros.straightness.text import decimal

__all__ = ["Direction", "Run", "Survey", "SurveyError", "read_survey", "write_survey"]

_DIRECTIONS = ("forward", "backward")


@dataclass(frozen=True)
class Survey:
    """All runs of a survey, in the order of the file; ``source`` is the file's name for messages."""

    runs: tuple[Run, ...]
    source: str = "survey"

    def in_direction(self, direction: Direction) -> tuple[Run, ...]:
        """The runs of one direction."""
        return tuple(run for run in self.runs if run.direction == direction)


@dataclass
class _Rows:
    """What was read of one run, in the order of the file."""

    lines: list[int] = field(default_factory=list)
    x: list[float] = field(default_factory=list)
    deviation: list[float] = field(default_factory=list)


def read_survey(path: str | Path, *, min_points: int = 20, max_gap: float = 0.05) -> Survey:
    """Read and check a survey.

    Args:
        path: the CSV file, UTF-8.
        min_points: fewest points that a run may have.
        max_gap: widest distance between neighbouring points in m.

    Raises:
        SurveyError: the file is missing or empty, lacks a column, holds what is no finite number, has too
            few points, an x that turns back or repeats, a gap, or values that no guide in these units has.
    """
    path = Path(path)
    lines = rows(path)
    header_line, cells = next(lines, (0, []))
    if not cells:
        raise SurveyError(f"survey {path}: is empty; allowed: a header row and at least {min_points} rows")
    header = [normalised(cell) for cell in cells]
    where = f"survey {path}, line {header_line}"
    x_column, deviation_column = find_column(where, header, X), find_column(where, header, DEVIATION)

    groups: dict[tuple[str, Direction | None], _Rows] = {}
    for line, row in lines:
        if len(row) != len(header):
            raise SurveyError(
                f"survey {path}, line {line}: {len(row)} cells, the header has {len(header)} "
                "(is there a decimal comma?)"
            )
        name = row[header.index("run")].strip() if "run" in header else "1"
        group = groups.setdefault((name, _direction(path, line, header, row)), _Rows())
        group.lines.append(line)
        group.x.append(metres(path, line, row, x_column))
        group.deviation.append(metres(path, line, row, deviation_column))
    if not groups:
        raise SurveyError(f"survey {path}: has a header but no rows; allowed: at least {min_points} rows")

    runs = []
    for (name, direction), group in groups.items():
        where = f"survey {path}, run '{name}'{f' {direction}' if direction else ''}"
        if len(group.x) < max(min_points, 2):
            raise SurveyError(f"{where}: {len(group.x)} points; allowed: >= {min_points} (min_points)")
        run = orient(where, name, direction, group.lines, group.x, group.deviation)
        # Units before gaps: x in the wrong unit would else be called a gap of metres.
        X.check_extent(where, float(run.x[-1] - run.x[0]), x_column.unit)
        DEVIATION.check_extent(where, float(np.ptp(run.deviation)), deviation_column.unit)
        check_gaps(where, run, max_gap)
        runs.append(run)
    return Survey(tuple(runs), str(path))


def write_survey(path: str | Path, survey: Survey, comments: Sequence[str] = ()) -> None:
    """Write ``survey`` in mm and µm, to 0.1 µm in x and 1 nm in deviation; backward runs as driven, x falling.

    Args:
        path: the file, replaced if it exists.
        survey: what to write.
        comments: lines for the head of the file, without the ``#``.
    """
    lines = [f"# {comment}" for comment in comments]
    lines.append("run,direction,x_mm,deviation_um")
    for run in survey.runs:
        order = slice(None) if run.direction == "forward" else slice(None, None, -1)
        lines += [
            f"{run.name},{run.direction},{decimal(x * 1e3, 4)},{decimal(deviation * 1e6, 3)}"
            for x, deviation in zip(run.x[order].tolist(), run.deviation[order].tolist(), strict=True)
        ]
    # newline="" keeps the bytes the same on every system.
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        file.write("\n".join(lines) + "\n")


def _direction(path: Path, line: int, header: Sequence[str], row: Sequence[str]) -> Direction | None:
    if "direction" not in header:
        return None
    direction = row[header.index("direction")].strip().lower()
    if direction not in _DIRECTIONS:
        raise SurveyError(f"survey {path}, line {line}: direction {direction!r}; allowed: {' or '.join(_DIRECTIONS)}")
    return cast(Direction, direction)
