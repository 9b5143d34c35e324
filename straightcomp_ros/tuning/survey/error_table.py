"""The deviation of a guide at given positions, which every file format holds in its own way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.survey import DEVIATION, Direction, Run, Survey, SurveyError, X

UNITS = {"mm": 1e3, "inch": 1.0 / 0.0254, "m": 1.0, "um": 1e6}
"""How many of a unit make a metre, for files whose unit is set in the controller and not in the file."""


@dataclass(frozen=True)
class Conventions:
    """What a file of a controller does not say by itself.

    Attributes:
        unit: length unit of the machine's configuration, a key of :data:`UNITS`.
        stage_axis, platform_axis: numbers of the two axes in the controller, from 1.
        error: name of the straightness error in ISO 230-1's notation: EYX is the error in Y of a motion along X.
    """

    unit: str = "mm"
    stage_axis: int = 1
    platform_axis: int = 2
    error: str = "EYX"

    def __post_init__(self) -> None:
        moved, axis = self.error[1:2], self.error[2:3]
        if not (len(self.error) == 3 and self.error[0] == "E" and {moved, axis} <= set("XYZ") and moved != axis):
            raise SurveyError(
                f"error {self.error!r}: is no straightness; allowed: E, the axis of the error and the axis that moves, "
                "two of X, Y and Z: EYX, EZX, …"
            )

    @property
    def per_metre(self) -> float:
        """How many units make a metre."""
        return UNITS[self.unit]


@dataclass(frozen=True, eq=False)
class ErrorTable:
    """Deviation δ over x; the correction that a controller adds is −δ.

    Attributes:
        x: (n,) positions of the stage in m, strictly ascending.
        forward: (n,) deviation in m, moving towards larger x.
        backward: the same, moving towards smaller x; None if the file has one value for both directions.
    """

    x: NDArray[np.float64]
    forward: NDArray[np.float64]
    backward: NDArray[np.float64] | None = None

    def plus(self, other: ErrorTable) -> ErrorTable:
        """The sum of two tables without directions, as a controller adds them: linear between two points, and beyond
        the ends the last value."""
        x = np.union1d(self.x, other.x)
        return ErrorTable(x, np.interp(x, self.x, self.forward) + np.interp(x, other.x, other.forward))

    @property
    def mean(self) -> NDArray[np.float64]:
        """(n,) mean deviation of both directions in m, for formats with one value for both."""
        return self.forward if self.backward is None else 0.5 * (self.forward + self.backward)

    def negated(self) -> ErrorTable:
        """The table with the other sign, for a controller that counts the other way."""
        return ErrorTable(self.x, -self.forward, None if self.backward is None else -self.backward)

    def check_size(self, controller: str, most: int) -> None:
        """Raise SurveyError for more than ``most`` points, which ``controller`` cannot hold."""
        if len(self.x) > most:
            raise SurveyError(f"{len(self.x)} points; allowed for {controller}: <= {most}: take a larger spacing")

    def to_survey(self, source: str) -> Survey:
        """One run for each direction that the table knows; ``source`` is the file's name for messages.

        SurveyError for lengths that no guide has: more likely a wrong unit than an odd machine.
        """
        where = f"survey {source}"
        X.check_extent(where, float(self.x[-1] - self.x[0]))
        ways: dict[Direction, NDArray[np.float64] | None] = {"forward": self.forward, "backward": self.backward}
        runs = [Run("1", way, self.x, deviation) for way, deviation in ways.items() if deviation is not None]
        for run in runs:
            DEVIATION.check_extent(where, float(np.ptp(run.deviation)))
        return Survey(tuple(runs), source)


def error_table(where: str, points: list[list[float]]) -> ErrorTable:
    """A table from points of (x, deviation), or of (x, forward, backward), in m; ``where`` begins the messages.

    SurveyError for fewer than two points, or two at one x.
    """
    if len(points) < 2:
        raise SurveyError(f"{where}: {len(points)} points; allowed: >= 2")
    x, *deviations = np.array(sorted(points)).T
    same = np.flatnonzero(np.diff(x) <= 0.0)
    if same.size:
        raise SurveyError(f"{where}: x = {x[same[0]] * 1e3:.10g} mm is given twice; allowed: once")
    return ErrorTable(x, *deviations)


def sampled(straightness: StraightnessMap, spacing: float) -> tuple[ErrorTable, float]:
    """The map at equal distances of at most ``spacing`` in m over its span, both ends included, as a table whose
    correction is the map's reference; and the largest error in m of a controller that interpolates linearly in it.
    """
    first, last = straightness.span
    pieces = max(1, math.ceil((last - first) / spacing - 1e-9))
    x = np.asarray(np.linspace(first, last, pieces + 1), np.float64)
    table = ErrorTable(x, -straightness.evaluate(x)[0])
    fine = np.linspace(first, last, 16 * pieces + 1)
    return table, float(np.abs(np.interp(fine, x, table.forward) + straightness.evaluate(fine)[0]).max())
