"""The runs of a survey together: on one grid of x, their mean and repeatability.

Mean and repeatability are those of ISO 230-2:2014, which defines repeatability for positioning; here the deviation
across the motion takes the place of the one along it. At each point i, over the n runs of one direction: the mean, and
the estimator s_i of the standard uncertainty, the sample standard deviation (divisor n − 1). From these, with the
coverage factor 2 of the standard,

    unidirectional repeatability  R_i↑ = 4 s_i↑,  R_i↓ = 4 s_i↓
    reversal value                B_i = mean_i↑ − mean_i↓
    bidirectional repeatability   R_i = max(2 s_i↑ + 2 s_i↓ + |B_i|, R_i↑, R_i↓)

and of each the largest over the points is the figure of the axis. The standard asks for five runs each way; fewer make
the figures less certain. Offsets between runs count: nothing is removed from a run before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from straightcomp_ros.straightness.residual import Array, peak_to_peak
from straightcomp_ros.straightness.survey import GRACE, Survey
from straightcomp_ros.straightness.survey_header import WAYS, Direction, SurveyError

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_RECOMMENDED = 5
_AS_FINE = 1.25
"""Points of a run, relative to another's, up to which that one may have lost the others: rejected, or at its ends."""


def cubic_spline(x: Array, values: Array) -> CubicSpline:
    """Spline with continuous curvature and not-a-knot ends through ``values`` (n,) in m at ascending ``x`` in m."""
    # SciPy takes half of the time that a node needs to start, and a node without a map needs none of it.
    from scipy.interpolate import CubicSpline

    return CubicSpline(x, values)


def point_weights(x: Array, at: Array, weights: Array) -> Array:
    """``weights`` (p, m) of the values at ``at`` (m,) of :func:`cubic_spline` through points at ``x`` (n,), as weights
    (p, n) of the values at these points. No matrix of (m, n) is made: both may be tens of thousands."""
    from scipy.interpolate import BSpline
    from scipy.sparse.linalg import spsolve

    knots = np.concatenate([np.repeat(x[0], 4), x[2:-2], np.repeat(x[-1], 4)])
    through, values = (BSpline.design_matrix(one, knots, 3, extrapolate=True) for one in (x, at))
    return np.asarray(spsolve(through.T.tocsc(), values.T @ weights.T).T)


def on_common_grid(survey: Survey, min_points: int, max_gap: float) -> tuple[Array, Array]:
    """The x of one run, cut to the range that all runs cover, and all runs at these x.

    It is the run with the most points, of equal ones the first, of those that are about as fine as the median: at the
    points of a run that is much finer than most, its noise would be taken for hysteresis. Half of the runs are most.

    Runs with other x are interpolated by a cubic spline through their points (linear interpolation would cut 0.02 µm
    off a wave of 150 mm and 1 µm at 10 mm spacing); at a run's own points the spline is the measured value.

    Returns x (n,) in m, and values (runs, n) in m in the survey's order of runs; SurveyError for no run, ends that
    differ by more than ``max_gap`` in m, or fewer than ``min_points`` common points.
    """
    if not survey.runs:
        raise SurveyError(f"survey {survey.source}: has no run; allowed: at least one")
    starts, ends = [run.x[0] for run in survey.runs], [run.x[-1] for run in survey.runs]
    for what, at in (("start", starts), ("end", ends)):
        if max(at) - min(at) > max_gap + GRACE:
            raise SurveyError(
                f"survey {survey.source}: the runs {what} between x = {min(at) * 1e3:.10g} mm and "
                f"{max(at) * 1e3:.10g} mm; allowed: within {max_gap * 1e3:.6g} mm (max_gap); was a run broken off?"
            )
    low, high = max(starts), min(ends)
    sizes = [run.x.size for run in survey.runs]
    most = _AS_FINE * sorted(sizes)[len(sizes) // 2]
    typical = max((run.x for run in survey.runs if run.x.size <= most), key=len)
    # Half a step of room to the ends: triggers jitter, and two points a micrometre apart make the spline wild.
    room = 0.5 * float(np.median(np.diff(typical)))
    grid = np.concatenate([[low], typical[(typical > low + room) & (typical < high - room)], [high]])
    if grid.size < max(min_points, 4):
        raise SurveyError(
            f"survey {survey.source}: {grid.size} points in the range that all runs cover; "
            f"allowed: >= {min_points} (min_points)"
        )
    values = [
        run.deviation if np.array_equal(run.x, grid) else cubic_spline(run.x, run.deviation)(grid)
        for run in survey.runs
    ]
    return grid, np.array(values)


class Directed(NamedTuple):
    """One direction: number of ``runs``, and over the points (n,) in m ``mean`` and ``s`` (None for a single run)."""

    runs: int
    mean: Array
    s: Array | None

    @property
    def repeatability(self) -> float | None:
        """R↑ or R↓ in m."""
        return None if self.s is None else 4.0 * float(self.s.max())


class Repeatability(NamedTuple):
    """How well the runs of a survey agree.

    Attributes:
        x: (n,) points in m.
        forward, backward: None for a direction that was not driven.
        mean: (n,) in m, of the forward mean and the backward mean, whatever the number of runs of each.
        reversal: B_i (n,) in m; None without both directions.
        bidirectional: R in m; None unless both directions have two runs.
    """

    x: Array
    forward: Directed | None
    backward: Directed | None
    mean: Array
    reversal: Array | None
    bidirectional: float | None

    @property
    def short_of_the_standard(self) -> bool:
        """True when a direction has fewer than the five runs of ISO 230-2."""
        return any(one is None or one.runs < _RECOMMENDED for one in (self.forward, self.backward))

    def __str__(self) -> str:
        runs = [one.runs if one else 0 for one in (self.forward, self.backward)]
        text = f"{len(self.x)} points, {runs[0]} forward and {runs[1]} backward runs"
        text += f", {peak_to_peak(self.mean) * 1e6:.2f} µm peak to peak"
        spreads = [float(one.s.max()) for one in (self.forward, self.backward) if one and one.s is not None]
        if spreads:
            text += f", standard deviation at most {max(spreads) * 1e6:.3f} µm"
        if self.reversal is not None:
            text += f", hysteresis {float(np.abs(self.reversal).max()) * 1e6:.3f} µm"
        return text

    def to_display(self) -> dict[str, float | None]:
        """The figures as a person reads them: lengths in µm."""
        reversal = self.reversal
        figures = {
            "repeatability_forward": self.forward.repeatability if self.forward else None,
            "repeatability_backward": self.backward.repeatability if self.backward else None,
            "repeatability_bidirectional": self.bidirectional,
            "reversal_max": None if reversal is None else float(np.abs(reversal).max()),
            "reversal_mean": None if reversal is None else float(reversal.mean()),
        }
        return {f"{name}_um": None if value is None else value * 1e6 for name, value in figures.items()}


def repeatability(survey: Survey, x: Array, values: Array) -> Repeatability:
    """The figures of a survey at ``x`` (n,) in m, with ``values`` (runs, n) in m, both of :func:`on_common_grid`."""

    def directed(way: Direction) -> Directed | None:
        chosen = values[[run.direction == way for run in survey.runs]]
        s = chosen.std(axis=0, ddof=1) if len(chosen) > 1 else None
        return Directed(len(chosen), chosen.mean(axis=0), s) if len(chosen) else None

    forward, backward = map(directed, WAYS)
    mean = np.asarray(np.mean([one.mean for one in (forward, backward) if one], axis=0))
    reversal = both = None
    if forward and backward:
        reversal = forward.mean - backward.mean
        if forward.s is not None and backward.s is not None:
            bidirectional = 2.0 * forward.s + 2.0 * backward.s + np.abs(reversal)
            both = float(np.max([bidirectional, 4.0 * forward.s, 4.0 * backward.s]))
    return Repeatability(x, forward, backward, mean, reversal, both)
