"""Straightedge reversal: the guide without the errors of the straightedge, from two surveys of it.

The sensor on the slider reads m1 = guide + edge along the straightedge. For the second survey the straightedge is
turned over about its long axis, at the same place along x, and the sensor with it, so that it reads from the other
side: the edge has the same sign again, the guide the other one, m2 = edge − guide. Therefore

    guide = (m1 − m2) / 2        edge = (m1 + m2) / 2

(C. J. Evans, R. J. Hocken and W. T. Estler, Self-calibration: reversal, redundancy, error separation, and 'absolute
testing', CIRP Annals 45, 1996). A line is removed from each: straightedge and guide are aligned anew for each survey.
The runs of both surveys are taken in pairs, so that the separated runs have the noise of the measurement: of two runs
with the standard deviations s1 and s2 it is √(s1² + s2²) / 2.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.map_building import MAP
from straightcomp_ros.straightness.residual import least_squares_residual
from straightcomp_ros.straightness.smoothing import point_noise
from straightcomp_ros.straightness.survey import Run, Survey, SurveyError
from straightcomp_ros.straightness.survey_runs import on_common_grid, repeatability

Array = NDArray[np.float64]


class Separated(NamedTuple):
    """Runs of the ``guide`` and of the ``edge``, one for each pair of runs; at ``x`` (n,) in m the mean deviations in m
    of both, whose standard deviation at one point is ``noise`` in m (None without a second pair of a direction).
    ``left_out`` is the number of runs without a partner."""

    guide: Survey
    edge: Survey
    x: Array
    guide_mean: Array
    edge_mean: Array
    noise: float | None
    left_out: int


def separated(normal: Survey, turned: Survey) -> Separated:
    """Guide and edge from the survey with the straightedge as it was and that with it ``turned`` over.

    Raises:
        SurveyError: the surveys do not cover the same x, or have no direction in common.
    """
    every = (*normal.runs, *turned.runs)
    x, values = on_common_grid(Survey(every, f"{normal.source} and {turned.source}"), MAP.min_points, MAP.max_gap)
    first, second = values[: len(normal.runs)], values[len(normal.runs) :]
    guides, edges = list[Run](), list[Run]()
    for way in ("forward", "backward"):
        ones, others = (
            of_survey[[run.direction == way for run in survey.runs]]
            for survey, of_survey in ((normal, first), (turned, second))
        )
        for number, (one, other) in enumerate(zip(ones, others, strict=False), 1):
            for runs, curve in ((guides, one - other), (edges, one + other)):
                runs.append(Run(str(number), way, x, least_squares_residual(x, curve / 2.0)))
    if not guides:
        raise SurveyError(f"survey {turned.source}: has no run in a direction of {normal.source}; allowed: the same")
    guide, edge = Survey(tuple(guides), "guide"), Survey(tuple(edges), "edge")
    curves = np.array([run.deviation for run in guides])
    guide_mean, edge_mean = (
        repeatability(one, x, np.array([run.deviation for run in one.runs])).mean for one in (guide, edge)
    )
    noise = point_noise(guide, x, curves, np.ones(curves.shape, np.bool_))
    return Separated(guide, edge, x, guide_mean, edge_mean, noise, len(every) - 2 * len(guides))
