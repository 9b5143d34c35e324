"""Whether the guide is another one on the way back: half the difference of a survey's forward and backward runs.

A guide whose carriages settle otherwise in each direction shows itself in every pair of runs; a drift of the instrument
changes from run to run, and noise from point to point. So each part of h = (forward − backward)/2 is held against what
would imitate it: level and tilt against the scatter of the runs' own lines by Student's t, what is left of h over x
against the noise of a point by Fisher's F, at all points, and in its slow waves alone, where hysteresis mostly is. A
part that chance would bring once in a thousand surveys of a guide without hysteresis counts. The others are left out,
so that the map is the mean of both directions where none counts.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from straightcomp_ros.straightness.residual import Array
from straightcomp_ros.straightness.smoothing import ROUNDING, MapNoise, drifts, measured, smoothed
from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.straightness.survey_runs import cubic_spline

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

_BY_CHANCE = 1e-3
"""Share of surveys of a guide without hysteresis in which a part may count."""


_SLOW = 9
"""Degree of the polynomials that are slow waves: half-waves over the survey."""


def half_difference(
    survey: Survey, x: Array, values: Array, mean: Array, noise: MapNoise, how: str, always: bool
) -> tuple[PPoly, MapNoise] | None:
    """A spline of h in m over ``x`` (n,) in m, and the noise of mean and h together, which is that of one direction.

    ``values`` (runs, n) are the survey's at ``x``, ``mean`` (n,) is that of both directions and ``noise`` its noise,
    all in m; ``how`` is the smoothing as :func:`smoothed` takes it. None without both directions, and, unless
    ``always``, where h is not more than the noise explains or no run was repeated.
    """
    ways = np.array([1.0 if run.direction == "forward" else -1.0 for run in survey.runs])
    if abs(ways.sum()) == len(ways) or not (always or noise.repeated):
        return None
    apart = ways[:, None] * (values - mean)
    half = np.mean([apart[ways == way].mean(axis=0) for way in (1.0, -1.0)], axis=0)
    line = np.asarray(np.polyval(np.polyfit(x, half, 1), x), np.float64)
    if always:
        kept, shaped = line, True
    else:
        kept = _lasting(ways, x, drifts(x, apart, measured(survey, x)), line)
        shaped = _more_than_chance(x, half - line, noise.point, len(ways) - 2)
    if not shaped:
        return (cubic_spline(x, kept), noise) if kept.any() else None
    spline, own = smoothed(survey, x, apart - line + kept, half - line + kept, how)
    together = replace(
        noise,
        point=math.hypot(noise.point, own.point),
        deviation=np.hypot(noise.deviation, own.band(noise.x)),
        twice=math.hypot(noise.twice, own.twice),
    )
    return spline or cubic_spline(x, half - line + kept), together


def _lasting(ways: Array, x: Array, lines: Array, line: Array) -> Array:
    """Of the ``line`` (n,) of h the level and the tilt that are more than the scatter of the runs' ``lines`` (runs, n)
    explains."""
    from scipy.special import stdtrit

    freedom = len(ways) - 2
    kept = np.zeros_like(line)
    if freedom < 1:
        return kept
    middle = (x - x.mean()) / np.ptp(x)
    level, tilt = line.mean(), line[-1] - line[0]
    levels, tilts = lines.mean(axis=1), lines[:, -1] - lines[:, 0]
    for size, sizes, shape in ((level, levels, np.ones_like(x)), (tilt, tilts, middle)):
        squares = sum(float(sizes[ways == way].var()) * np.count_nonzero(ways == way) for way in (1.0, -1.0))
        counts = sum(1.0 / np.count_nonzero(ways == way) for way in (1.0, -1.0))
        error = 0.5 * math.sqrt(squares / freedom * counts)
        if abs(size) > max(ROUNDING, -error * float(stdtrit(freedom, _BY_CHANCE / 2.0))):
            kept = kept + size * shape
    return kept


def _more_than_chance(x: Array, shape: Array, noise: float, repeats: int) -> bool:
    """Whether ``shape`` (n,) in m over ``x`` (n,), without level and tilt, is more than ``noise`` in m, which is known
    from as many ``repeats`` of all points."""
    from scipy.special import fdtri

    freedom = shape.size - 2
    orthogonal = np.linalg.qr(np.polynomial.legendre.legvander(2.0 * (x - x[0]) / np.ptp(x) - 1.0, _SLOW))[0]
    slow = shape @ orthogonal[:, 2:]
    return any(
        float(part @ part) / count
        > max(noise, ROUNDING) ** 2 * float(fdtri(count, repeats * freedom, 1.0 - _BY_CHANCE / 2.0))
        for part, count in ((shape, freedom), (slow, slow.size))
    )
