"""How much of a survey is noise, and the spline that takes it off: as smooth as the noise warrants, and no more.

The noise of a point is the standard deviation between the runs of one direction, pooled over x, with each run's offset
and slope (drift) taken off. The spline f is cubic and minimises, over the n points of the runs' mean,

    Σ w_i (y_i − f(x_i))² + ∫ λ(x) f'''(x)² dx

The third derivative leaves a parabola, and so the curvature at the ends, as it is. No single λ is chosen: the map
is the mean of the splines of all λ, each with the weight exp(−C_p/4), where C_p is the estimate of its squared error
from the known noise, in units of that (C. L. Mallows, Technometrics 15, 1973; G. Leung and A. R. Barron, IEEE Trans.
Inf. Theory 52, 2006). With a single run the noise is that of the residual, at the λ of generalised cross validation
(P. Craven and G. Wahba, Numer. Math. 31, 1979). At a joint or kink λ(x) is smaller: no larger than the largest whose
fit differs from none of the less smooth ones by more than the noise can explain (O. V. Lepski, Theory Probab. Appl. 35,
1990).

The band is Wahba's, the posterior standard deviation of a spline as a Gaussian process, which contains the bias on
average over x (G. Wahba, J. R. Stat. Soc. B 45, 1983), over all of them: mean variance and the variance between them
(S. T. Buckland, K. P. Burnham and N. H. Augustin, Biometrics 53, 1997). It does not contain the survey's zero and tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.straightness.residual import Array, rms
from straightcomp_ros.straightness.survey import Survey
from straightcomp_ros.straightness.survey_header import WAYS
from straightcomp_ros.straightness.survey_runs import cubic_spline

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

NORMAL_95 = 1.96
"""Standard deviations to each side that hold 95 % of a normal distribution."""
_CLEAN = 0.6
"""Fraction of its variance that smoothing must leave of the noise at most; else it is taken off only where it bends."""
_UNLIKELY = 0.02
"""Weight up to which a λ is left out."""
ROUNDING = 1e-9 / math.sqrt(12.0)
"""Noise in m that nothing is done about: that of a survey file's rounding to a nanometre."""
_BY_CHANCE = 0.05
"""Share of even guides on which noise may make a smoother fit differ somewhere from a less smooth one so much that it
is taken for the guide: at one of as many independent places as the roughest fit has degrees of freedom (Bonferroni)."""
_MOST_KNOTS = 600
_TOO_COARSE = 1.2
"""Typical square of the residual, in units of the noise, beyond which the guide is rougher than these knots follow."""
_MEDIAN_OF_SQUARES = 0.455
"""Of a standard normal variable; not moved by a step at a joint, which no knots follow."""
_BENDS = 2.0
"""Largest curvature of a map relative to that of the smooth curve: more is noise, and asks for an acceleration."""
_SMOOTHEST, _MOST = 1e12, 1e15
"""Largest λ in units of the inverse of the stiffest mode's penalty; beyond it rounding would reach the softest. And the
largest with a factor; beyond it rounding would move the whole spline."""


@dataclass(frozen=True, eq=False)
class MapNoise:
    """What the noise of a survey leaves in its map.

    Attributes:
        point: standard deviation in m of the mean of all runs at one point.
        runs: number of runs.
        repeated: whether a direction has two runs; else the noise is that of the residual of a smooth curve.
        smoothed: whether noise was taken off; else the map goes through every mean.
        x, deviation: (n,) in m: where the standard deviation of the map is given, and that.
        twice: RMS over x of the standard deviation in m that a survey of twice as many runs would leave.
    """

    point: float
    runs: int
    repeated: bool
    smoothed: bool
    x: Array
    deviation: Array
    twice: float

    @property
    def half_width(self) -> float:
        """Half width in m of the band that contains the guide with 95 %, RMS over x."""
        return NORMAL_95 * rms(self.deviation)

    def band(self, x: Array) -> Array:
        """Standard deviation of the map in m at ``x`` in m."""
        return np.asarray(np.interp(x, self.x, self.deviation))

    def __str__(self) -> str:
        if self.point <= ROUNDING:
            return "the survey shows no noise"
        more = f"{self.runs} more runs" if self.runs > 1 else "one more run"
        text = f"the survey's noise leaves ±{self.half_width * 1e6:.2g} µm (95 %)"
        text += f"; {more} would leave ±{NORMAL_95 * self.twice * 1e6:.2g} µm"
        if not self.repeated:
            text += "; estimated from the residual, since no run was repeated"
        return text


def point_noise(survey: Survey, x: Array, values: Array, own: NDArray[np.bool_]) -> float | None:
    """Standard deviation in m of the mean of both directions at one point, from ``values`` (runs, n) at ``x`` (n,), of
    which those that are ``own`` (runs, n) count; None unless two runs of one direction share points. A direction whose
    runs share none is taken to be as noisy as the other."""
    counts, repeats, sums = list[int](), list[int](), list[float]()
    for way in WAYS:
        chosen = np.array([run.direction == way for run in survey.runs])
        if chosen.any():
            apart = values[chosen] - values[chosen].mean(axis=0)
            # Where one run alone has a point, nothing shows its noise.
            shared = own[chosen] & (own[chosen].sum(axis=0) > 1)
            counts.append(len(apart))
            freedom = float(shared.sum() - shared.any(axis=0).sum()) / max(len(apart) - 1, 1) - 2.0
            repeats.append(len(apart) - 1 if freedom > 0.0 else 0)
            apart = np.where(shared, apart - drifts(x, apart, own[chosen]), 0.0)
            sums.append(float(np.sum(apart**2)) / freedom if freedom > 0.0 else 0.0)
    if not any(repeats):
        return None
    pooled = sum(sums) / sum(repeats)
    variances = [total / more if more else pooled for total, more in zip(sums, repeats, strict=True)]
    return math.sqrt(sum(v / count for v, count in zip(variances, counts, strict=True))) / len(counts)


def drifts(x: Array, values: Array, own: NDArray[np.bool_]) -> Array:
    """The least squares line (runs, n) of each run's ``own`` ``values`` (runs, n) over ``x`` (n,)."""
    return np.array([np.polyval(np.polyfit(x[ours], run[ours], 1), x) for run, ours in zip(values, own, strict=True)])


def measured(survey: Survey, x: Array) -> NDArray[np.bool_]:
    """Whether each run has a point of its own near each of ``x`` (n,): (runs, n). Its other values are interpolated,
    where a point was missing or rejected."""
    room = 0.5 * float(np.median(np.diff(x)))
    return np.array([np.abs(run.x[_nearest(run.x, x)] - x) <= room for run in survey.runs])


def filled(x: Array, values: Array, own: NDArray[np.bool_]) -> Array:
    """``values`` (runs, n) with the mean of the other runs, and the run's drift, where a run has no point of its own:
    across a wide gap a spline would carry the noise of its ends far away."""
    drift = drifts(x, values - (own * values).sum(axis=0) / own.sum(axis=0), own)
    common = (own * (values - drift)).sum(axis=0) / own.sum(axis=0)
    return np.where(own, values, common + drift)


def smoothed(survey: Survey, x: Array, values: Array, mean: Array, how: str) -> tuple[PPoly | None, MapNoise]:
    """The smoothing spline through ``mean`` (n,) at ``x`` (n,) of ``values`` (runs, n), all in m, and its noise.

    ``how`` is ``none``; ``auto``, by the noise; or the number by which that λ is multiplied. The spline is None where
    ``mean`` is to be interpolated: for ``none``, 0, and with ``auto`` where the noise makes the curvature at most twice
    as large, and smoothing would take off little or no run was repeated.
    """
    own, runs = measured(survey, x), len(values)
    if not own.all():
        values = filled(x, values, own)
        ways = np.array([run.direction == "forward" for run in survey.runs])
        mean = np.mean([values[ways == way].mean(axis=0) for way in np.unique(ways)], axis=0)
    noise = point_noise(survey, x, values, own)
    repeated = noise is not None
    factor = float({"auto": "1", "none": "0"}.get(how, how))
    if noise is not None and (factor == 0.0 or noise <= ROUNDING):
        return None, _as_measured(noise, runs, repeated, x)
    # SciPy takes half of the time that a node needs to start, and a node without a map needs none of it.
    from scipy.interpolate import BSpline, PPoly
    from scipy.linalg import eigh, solveh_banded
    from scipy.sparse import csr_array
    from scipy.special import ndtri

    # No knot at the second point from either end, as in the spline through all points.
    fine = len(x) > _MOST_KNOTS
    knots = x[np.unique(np.searchsorted(x, np.linspace(x[0], x[-1], _MOST_KNOTS)))] if fine else x
    knots = np.delete(knots, [1, -2])
    padded = np.concatenate([[knots[0]] * 3, knots, [knots[-1]] * 3])
    at_points, at_knots = (BSpline.design_matrix(at, padded, 3) for at in (x, knots))
    weight = own.mean(axis=0)
    information = at_points.T @ at_points.multiply(weight[:, None])
    sums = at_points.T @ (weight * mean)
    middles, lengths = (knots[1:] + knots[:-1]) / 2.0, np.diff(knots)
    # The third derivative of a cubic is constant between two knots.
    third = BSpline(padded, np.eye(len(sums)), 3)(middles, 3)
    # Modes that are independent for every λ (A. Demmler and C. Reinsch, Numer. Math. 24, 1975).
    stiffness, modes = eigh(third.T @ (lengths[:, None] * third), information.toarray())
    stiffness = np.maximum(stiffness, 0.0)
    choices = np.geomspace(1.0, _SMOOTHEST, 25) / stiffness[-1]
    kept = 1.0 / (1.0 + choices[:, None] * stiffness)
    amounts = modes.T @ sums
    fits = at_points @ (modes @ (kept * amounts).T)
    squares, freedom = weight @ (mean[:, None] - fits) ** 2, kept.sum(axis=1)
    if noise is None:
        best = int((squares / (len(x) - freedom) ** 2).argmin())
        noise = math.sqrt(squares[best] / (len(x) - freedom[best]))
    risks = squares + 2.0 * noise**2 * freedom
    typical = float(np.median(weight * (mean - fits[:, 0]) ** 2)) / _MEDIAN_OF_SQUARES
    rough = fine and typical > _TOO_COARSE * noise**2 * (1.0 - freedom[0] / len(x))
    if factor == 0.0 or (how == "auto" and (rough or noise <= ROUNDING)):
        return None, _as_measured(noise, runs, repeated, x)

    likely = np.exp((risks.min() - risks) / (4.0 * noise**2))
    likely /= likely.sum()
    smoothest = int(np.flatnonzero(likely > _UNLIKELY)[-1])
    shapes = at_knots @ modes
    curves, shapes = shapes @ (kept * amounts).T, shapes**2
    detected = -float(ndtri(_BY_CHANCE / 2.0 / freedom[0]))  # standard deviations, to either side
    local, holds = np.zeros(len(knots), np.intp), np.ones(len(knots), np.bool_)
    for smoother in range(1, smoothest + 1):
        spread = noise * np.sqrt(shapes @ ((kept[smoother] - kept[:smoother]) ** 2).T)
        holds &= np.all(np.abs(curves[:, [smoother]] - curves[:, :smoother]) <= detected * spread, axis=1)
        local[holds] = smoother

    def averaged(weights: Array) -> tuple[BSpline, Array, Array]:
        """The mean spline, and at the knots its variance and that of twice as many runs."""
        used, size = np.flatnonzero(weights > _UNLIKELY), len(sums)
        shares, basis, found = weights[used] / weights[used].sum(), at_knots.toarray(), list[Array]()
        sparse = csr_array(third)
        for choice in used:
            amount = factor * np.exp(np.interp(middles, knots, np.log(choices[np.minimum(local, choice)])))
            amount = np.minimum(amount, _MOST / stiffness[-1])
            penalty = sparse.T @ sparse.multiply((lengths * amount)[:, None])
            for times in (1.0, 2.0):
                matrix = times * information + penalty
                bands = np.array([np.pad(matrix.diagonal(k), (k, 0)) for k in (3, 2, 1, 0)])
                solved = solveh_banded(bands, np.column_stack([times * sums, basis.T]))
                found.append(np.append(solved[:, 0], noise**2 * np.sum(basis * solved[:, 1:].T, axis=1)))
        each = np.array(found).reshape(len(used), 2, -1)
        centre = shares @ each[:, 0, :size]
        between = shares @ ((each[:, 0, :size] - centre) @ basis.T) ** 2
        once, twice = np.einsum("i,ijk->jk", shares, each[:, :, size:])
        return BSpline(padded, centre, 3), once + between, twice + between / 2.0

    spline, variance, twice = averaged(likely)
    # Where smoothing takes off little, or no run was repeated so that the residual may be the guide, only what the law
    # cannot be asked to follow is taken off: such λ count as the least.
    little = (freedom > _CLEAN * len(x)) | (not repeated)
    if how == "auto" and (through := float(likely[little].sum())) > _UNLIKELY:
        whole = through >= 1.0 - _UNLIKELY
        shares = np.where(little, 0.0, likely)
        shares[0] = through
        found = (cubic_spline(x, mean), variance, twice) if whole else averaged(shares)
        if np.abs(found[0](x, 2)).max() <= _BENDS * np.abs(spline(x, 2)).max():
            if whole:
                return None, _as_measured(noise, runs, repeated, x)
            spline, variance, twice = found
    pieces = PPoly.from_spline(spline)
    return (
        PPoly(pieces.c[:, 3:-3], pieces.x[3:-3]),
        MapNoise(noise, runs, repeated, True, knots, np.sqrt(variance), float(np.sqrt(np.mean(twice)))),
    )


def _as_measured(noise: float, runs: int, repeated: bool, x: Array) -> MapNoise:
    return MapNoise(noise, runs, repeated, False, x, np.full_like(x, noise), noise / math.sqrt(2.0))


def _nearest(ascending: Array, x: Array) -> NDArray[np.intp]:
    """Index of the value of ``ascending`` that is nearest to each ``x``."""
    after = np.clip(np.searchsorted(ascending, x), 1, len(ascending) - 1)
    return np.asarray(after - (x - ascending[after - 1] < ascending[after] - x))
