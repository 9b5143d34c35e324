"""The check of a map by another survey of the same guide.

No encoder on the slider measures how straight the guide is. An independent measurement does, of the platform against a
straightedge or a laser, at some places and at least twice, so that its runs show its own uncertainty. Its line is
another one than the survey's: the least squares line of their difference is removed, so that a slope is not checked.
"""

from typing import NamedTuple

import numpy as np

from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import least_squares_residual, rms
from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.straightness.survey_runs import on_common_grid

LEAST_POINTS, WIDEST_GAP = 6, 0.5
"""With fewer points a guide is hardly distinguished from its line; m between neighbours."""
_CONFIDENCE = 0.999
_OPPOSITE = -0.9


class SurveyCheck(NamedTuple):
    """How a map agrees with a check; lengths in m, after removal of the least squares line of their difference.

    Attributes:
        points, runs: of the check, within the map's span.
        span: first and last x of them.
        difference: RMS of check less map.
        allowed: what it may be by the uncertainty of both, with a confidence of 99.9 %.
        guide: RMS of the map itself at these points, after removal of its own line.
        opposite: whether the check is much like the map with its sign turned over.
    """

    points: int
    runs: int
    span: tuple[float, float]
    difference: float
    allowed: float
    guide: float
    opposite: bool

    @property
    def agrees(self) -> bool:
        """Whether the map is within the uncertainty."""
        return self.difference <= self.allowed


def survey_check(straightness: StraightnessMap, check: Survey, noise: float) -> SurveyCheck:
    """Compare ``straightness`` with ``check``; ``noise`` is the standard deviation of the survey behind the map, m.

    Raises:
        SurveyError: the check has a single run, or too few points within the map's span.
    """
    from scipy.special import fdtri

    if len(check.runs) < 2:
        raise SurveyError(
            f"check survey {check.source}: has one run; allowed: >= 2, since their differences give its uncertainty"
        )
    x, values = on_common_grid(check, LEAST_POINTS, WIDEST_GAP)
    inside = (x >= straightness.span[0]) & (x <= straightness.span[1])
    points = int(inside.sum())
    if points < LEAST_POINTS:
        low, high = (f"{end * 1e3:.6g} mm" for end in straightness.span)
        raise SurveyError(
            f"check survey {check.source}: {points} points between {low} and {high}, where the map is; allowed: >= "
            f"{LEAST_POINTS}"
        )
    x, values = x[inside], values[:, inside]
    expected = straightness.deviations(x)
    left = np.array(
        [
            least_squares_residual(x, own - straightness.deviations(x, run.direction))
            for own, run in zip(values, check.runs, strict=True)
        ]
    )
    mean, runs = left.mean(axis=0), len(left)
    # A line takes two degrees of freedom of each run.
    freedom = points - 2
    variance = float(((left - mean) ** 2).sum()) / ((runs - 1) * freedom) / runs + noise**2
    factor = float(fdtri(freedom, (runs - 1) * freedom, _CONFIDENCE))
    guide = least_squares_residual(x, expected)
    measured = least_squares_residual(x, values.mean(axis=0))
    size = float(np.linalg.norm(guide) * np.linalg.norm(measured))
    return SurveyCheck(
        points=points,
        runs=runs,
        span=(float(x[0]), float(x[-1])),
        difference=float(np.sqrt(np.sum(mean**2) / freedom)),
        allowed=float(np.sqrt(factor * variance)),
        guide=rms(guide),
        opposite=bool(size > 0.0 and guide @ measured < _OPPOSITE * size),
    )
