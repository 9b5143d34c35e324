"""What the formats of controllers and instruments share: their conventions, and a survey as a list of points."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.survey import Run, Survey
from straightcomp_ros.straightness.survey_header import PER_METRE, WAYS, Direction, SurveyError

UNITS = {"mm": PER_METRE["mm"], "inch": PER_METRE["in"], "m": PER_METRE["m"], "um": PER_METRE["um"]}
"""How many of a unit make a metre, for files whose unit is set in the controller and not in the file."""
Points = Sequence[Sequence[float]]
"""Position of the stage and deviation of the guide in m, or position and the deviations forward and backward; the
correction that a controller adds is −deviation."""


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
        if not re.fullmatch(r"E([XYZ])(?!\1)[XYZ]", self.error):
            raise SurveyError(
                f"error {self.error!r}: is no straightness; allowed: E, the axis of the error and the axis that moves, "
                "two of X, Y and Z: EYX, EZX, …"
            )

    @property
    def per_metre(self) -> float:
        """How many units make a metre."""
        return UNITS[self.unit]

    def places(self, resolution: float) -> int:
        """Decimal places of numbers in the unit that keep a ``resolution`` in m, at least one."""
        return max(1, math.ceil(-math.log10(resolution * self.per_metre)))


def survey_of(where: str, points: Iterable[Sequence[float]], ways: Sequence[Direction] = WAYS) -> Survey:
    """The survey of points (x, deviation of each way, or of the first of them), in m, in any order.

    ``where`` begins the messages. SurveyError for fewer than two points, or two at one x.
    """
    ordered = sorted(tuple(point) for point in points)
    if len(ordered) < 2:
        raise SurveyError(f"{where}: {len(ordered)} points; allowed: >= 2")
    x, *deviations = np.array(ordered).T
    same = np.flatnonzero(np.diff(x) <= 0.0)
    if same.size:
        raise SurveyError(f"{where}: x = {x[same[0]] * 1e3:.10g} mm is given twice; allowed: once")
    return Survey(tuple(Run("1", way, x, values) for way, values in zip(ways, deviations, strict=False)), where)


def sampled(straightness: StraightnessMap, spacing: float) -> tuple[NDArray[np.float64], float]:
    """The map at equal distances of at most ``spacing`` in m over its span, both ends included: points (n, 2) whose
    correction is the map's reference, or (n, 3) of a map with a table for each direction; and the largest error in m of
    a controller that interpolates linearly in them.
    """
    first, last = straightness.span
    pieces = max(1, math.ceil((last - first) / spacing - 1e-9))
    x = np.linspace(first, last, pieces + 1)
    fine = np.linspace(first, last, 16 * pieces + 1)
    ways = WAYS if straightness.directed else (None,)
    deviations = [-straightness.evaluate(x, way)[0] for way in ways]
    error = max(
        np.abs(np.interp(fine, x, deviation) + straightness.evaluate(fine, way)[0]).max()
        for way, deviation in zip(ways, deviations, strict=True)
    )
    return np.column_stack([x, *deviations]), float(error)
