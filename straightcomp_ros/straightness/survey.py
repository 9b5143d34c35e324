"""The survey file: the measured deviation of the guide, as CSV.

    # any comment
    run,direction,x_mm,deviation_um
    1,forward,0,-3.796
    1,forward,10,-3.12

The column's name ends with the unit: x in m, mm or um, deviation in m, mm, um or nm. The names and separators of
instruments and spreadsheets are read as well: ``Position (mm)``, ``Straightness [µm]``, semicolons or tabs between the
cells, and then decimal commas; lines before the header, and Excel's ``sep=``. ``run`` and ``direction`` may be left
out: then the trend of x tells the direction, and where x turns back another run begins. Rows with the same run and
direction belong to one run, so that a cycle may count forward and backward as one. Other columns are ignored.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.survey_columns import DEVIATION, X, read_table
from straightcomp_ros.straightness.text import SurveyError, decimal

__all__ = ["Direction", "Run", "Survey", "SurveyError", "check_gaps", "orient", "read_survey", "write_survey"]

Direction = Literal["forward", "backward"]
_DIRECTIONS = ("forward", "backward")
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


@dataclass(frozen=True)
class Survey:
    """All runs of a survey, in the order of the file; ``source`` is the file's name for messages."""

    runs: tuple[Run, ...]
    source: str = "survey"

    def in_direction(self, direction: Direction) -> tuple[Run, ...]:
        """The runs of one direction."""
        return tuple(run for run in self.runs if run.direction == direction)

    def negated(self) -> "Survey":
        """The survey with the other sign, of an instrument or a controller that counts the other way."""
        return Survey(tuple(replace(run, deviation=-run.deviation) for run in self.runs), self.source)


def read_survey(
    path: str | Path, *, min_points: int = 20, max_gap: float = 0.05, names: Mapping[str, str] | None = None
) -> Survey:
    """Read and check a survey: at least ``min_points`` in a run, at most ``max_gap`` in m between neighbouring points.
    ``names`` as :func:`straightcomp_ros.straightness.survey_columns.read_table` takes it.

    Raises:
        SurveyError: the file is missing or empty, lacks a column, has a cell that is no finite number, too few points,
            an x that turns back or repeats, a gap, or values that no guide in these units has.
    """
    path = Path(path)
    table = read_table(path, names)
    groups: Groups = {}
    for line, row in table.rows:
        where = f"survey {path}, line {line}"
        cells = dict(zip(table.header, row, strict=True))
        direction = cells["direction"].strip().lower() if "direction" in cells else None
        if direction not in (None, *_DIRECTIONS):
            raise SurveyError(f"{where}: direction {direction!r}; allowed: {' or '.join(_DIRECTIONS)}")
        group = groups.setdefault((cells.get("run", "1").strip(), cast(Direction | None, direction)), [])
        group.append((line, table.x.metres(where, row), table.deviation.metres(where, row)))
    if not groups:
        raise SurveyError(f"survey {path}: has a header but no rows; allowed: at least {min_points} rows")

    if not {"run", "direction"} & set(table.header):
        groups = _passages(groups, min_points)
    runs = []
    for (name, way), points in groups.items():
        where = f"survey {path}, run '{name}'{f' {way}' if way else ''}"
        if len(points) < max(min_points, 2):
            raise SurveyError(f"{where}: {len(points)} points; allowed: >= {min_points} (min_points)")
        run = orient(where, name, way, points)
        # Units before gaps: x in the wrong unit would else be called a gap of metres.
        X.check_extent(where, float(run.x[-1] - run.x[0]), table.x.unit)
        DEVIATION.check_extent(where, float(np.ptp(run.deviation)), table.deviation.unit)
        check_gaps(where, run, max_gap)
        runs.append(run)
    return Survey(tuple(runs), str(path))


def _passages(groups: Groups, min_points: int) -> Groups:
    """The one run of a file that names none, split at the turning points of x: out and back, again and again.

    As it is where a passage is too short: there x does not turn, it is wrong.
    """
    ((_, points),) = groups.items()
    passages = [points[:1]]
    way = 0.0
    for before, point in itertools.pairwise(points):
        step = math.copysign(1.0, point[1] - before[1]) if point[1] != before[1] else 0.0
        if way and step != way:
            # Where x stands still at the turning point, the way back begins with the second point.
            passages.append([])
            way = 0.0
        else:
            way = step
        passages[-1].append(point)
    ways = [one[-1][1] > one[0][1] for one in passages]
    alternate = all(a is not b for a, b in itertools.pairwise(ways))
    if len(passages) == 1 or not alternate or min(map(len, passages)) < min_points:
        return groups
    names = ((str(n // 2 + 1), "forward" if rises else "backward") for n, rises in enumerate(ways))
    return dict(zip(names, passages, strict=True))  # type: ignore[arg-type]


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

    A backward run may be listed as it was driven or sorted by x. A forward run with falling x contradicts itself and is
    refused. Without ``direction``, the trend of x tells it.

    Args:
        points: at least two of (line number, x in m, deviation in m).

    Raises:
        SurveyError: x does not go one way, or contradicts ``direction``.
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


def check_gaps(where: str, run: Run, max_gap: float) -> None:
    """Refuse a run with neighbouring points farther apart than ``max_gap`` in m.

    Raises:
        SurveyError: with the position of the widest gap.
    """
    steps = np.diff(run.x)
    widest = int(np.argmax(steps))
    # A nanometre of grace: 0.05 m steps read from decimal text differ in the last bit.
    if steps[widest] > max_gap + 1e-9:
        raise SurveyError(
            f"{where}: no point between x = {run.x[widest] * 1e3:.10g} mm and {run.x[widest + 1] * 1e3:.10g} mm, "
            f"a gap of {steps[widest] * 1e3:.6g} mm; allowed: <= {max_gap * 1e3:.6g} mm (max_gap)"
        )
