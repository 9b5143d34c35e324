"""The survey file: the measured deviation of the guide, as CSV.

    # any comment
    run,direction,x_mm,deviation_um
    1,forward,0,-3.796
    1,forward,10,-3.12

`survey_table.py` says what else the units, names, marks and separators may be. ``run`` and ``direction`` may be left
out: another run then begins where x turns back or begins anew, and the trend of x gives the direction. Rows with the
same run and direction belong to one run, so that a cycle may count forward and backward as one, with ``direction`` or
without.
"""

import hashlib
import itertools
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.survey_header import DEVIATION, Direction, SurveyError, X
from straightcomp_ros.straightness.survey_table import (
    ALLOWED_WAYS,
    MARK,
    RUN_COLUMN,
    WAYS_IN_CELLS,
    decimal,
    numbered_lines,
    table_of,
)

GRACE = 1.01e-7
"""Length in m by which a gap may be too wide: as much as x that is written to 0.1 µm differs from what was measured."""
Groups = dict[tuple[str, Direction | None], list[tuple[int, float, float]]]
"""Points (line, x in m, deviation in m) by the name and the direction of their run."""


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

    @property
    def driven(self) -> NDArray[np.float64]:
        """x and deviation (2, n) in m in the order in which the stage moved: x falls in a backward run."""
        return np.stack([self.x, self.deviation])[:, :: 1 if self.direction == "forward" else -1]


@dataclass(frozen=True)
class Survey:
    """All runs of a survey, in the order of the file; ``source`` is the file's name for messages. ``facts`` are what
    the comments at the file's head say as ``name: text``, by name."""

    runs: tuple[Run, ...]
    source: str = "survey"
    facts: Mapping[str, str] = field(default_factory=dict, compare=False)

    @property
    def digest(self) -> str:
        """SHA-256 of the runs' numbers, as driven: of two runs that differ in direction alone they differ."""
        numbers = b"".join(run.driven.tobytes() for run in self.runs)
        return hashlib.sha256(numbers).hexdigest()

    @property
    def mark(self) -> str:
        """The encoder's reference that x was counted from; empty if the file does not name it."""
        return self.facts.get(MARK, "")

    def in_direction(self, direction: Direction) -> tuple[Run, ...]:
        """The runs of one direction."""
        return tuple(run for run in self.runs if run.direction == direction)


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
        if "direction" in cells and word not in WAYS_IN_CELLS:
            raise SurveyError(f"survey {path}, line {line}: direction {word!r}; allowed: {ALLOWED_WAYS}")
        direction = WAYS_IN_CELLS.get(word)
        key = (cells.get("run", cells.get(RUN_COLUMN, "1")), direction)
        groups.setdefault(key, []).append((line, x, deviation))
    if not groups:
        raise SurveyError(f"survey {path}: has a header but no rows; allowed: at least {min_points} rows")
    found = ""
    if not {"run", "direction"} <= {*table.header}:
        groups = _split(groups, "run" in table.header)
    if "run" not in table.header:
        found = " (no column 'run': another begins where x turns, if each covers more than half of x)"
    runs = []
    for (name, way), points in groups.items():
        where = f"survey {path}, run '{name}'{f' {way}' if way else ''}{found}"
        if len(points) < max(min_points, 2):
            raise SurveyError(f"{where}: {len(points)} points; allowed: >= {min_points} (min_points)")
        runs.append(orient(where, name, way, points))
        check_run(where, runs[-1], max_gap, table.columns)
    return Survey(tuple(runs), str(path), table.facts)


def _split(groups: Groups, named: bool) -> Groups:
    """The runs of a file that does not name all: another one begins where x turns back or begins anew. One that is
    ``named`` may be a cycle, once each way.

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
        ways: list[Direction] = [direction or ("forward" if part[-1][1] > part[0][1] else "backward") for part in parts]
        again = named and len({*ways}) < len(ways)
        if again or min(abs(part[-1][1] - part[0][1]) for part in parts) <= whole / 2.0:
            found[name, direction] = points
            continue  # It is refused as a run that turns back.
        for part, of_part in zip(parts, ways, strict=True):
            numbers[of_part] += 1
            found[name if named else str(numbers[of_part]), of_part] = part
    return found


def write_survey(path: str | Path, survey: Survey, comments: Sequence[str] = ()) -> None:
    """Write ``survey`` in mm and µm, to 0.1 µm in x and 1 nm in deviation; backward runs as driven, x falling.

    ``path`` is replaced in one step if it exists; ``comments`` are the lines at its head, without the ``#``.
    """
    lines = [*(f"# {comment}" for comment in comments), "run,direction,x_mm,deviation_um"]
    for run in survey.runs:
        name = run.name.replace('"', '""')
        # What begins with # would be a comment.
        name = f'"{name}"' if re.search(r'^#|[",]', name) else name
        lines += [
            f"{name},{run.direction},{decimal(x * 1e3, 4)},{decimal(deviation * 1e6, 3)}"
            for x, deviation in run.driven.T.tolist()
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
    rising = (x[-1] - x[0] or steps[0]) > 0.0
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
        _, units, _, low, high = quantity
        extent = float(np.ptp(values))
        if low <= extent <= high:
            continue
        fitting = [name for name, per_metre in units.items() if low <= extent * units[column] / per_metre <= high]
        hint = f"; is the unit wrong? It would fit as {' or '.join(fitting)}" if fitting else ""
        raise SurveyError(f"{where}: {column} extends over {extent:.6g} m; allowed: {low:g} m to {high:g} m{hint}")
    steps = np.diff(run.x)
    widest = int(np.argmax(steps))
    if steps[widest] > max_gap + GRACE:
        raise SurveyError(
            f"{where}: no point between x = {run.x[widest] * 1e3:.10g} mm and {run.x[widest + 1] * 1e3:.10g} mm, "
            f"a gap of {steps[widest] * 1e3:.6g} mm; allowed: <= {max_gap * 1e3:.6g} mm (max_gap)"
        )
