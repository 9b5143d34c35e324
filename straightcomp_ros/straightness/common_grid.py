"""All runs of a survey on one grid of x."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.straightness.survey import Survey, SurveyError

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


def cubic_spline(x: NDArray[np.float64], values: NDArray[np.float64]) -> CubicSpline:
    """Spline with continuous curvature and not-a-knot ends through ``values`` (n,) in m at ascending ``x`` in m."""
    # SciPy takes half of the time that a node needs to start, and a node without a map needs none of it.
    from scipy.interpolate import CubicSpline

    return CubicSpline(x, values)


def on_common_grid(survey: Survey, min_points: int, max_gap: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The x of the first run, cut to the range that all runs cover, and all runs at these x.

    Runs with other x are interpolated by a cubic spline through their points (linear interpolation would cut 0.02 µm
    off a wave of 150 mm and 1 µm at 10 mm spacing); at a run's own points the spline is the measured value.

    Args:
        survey: the runs.
        min_points: fewest points that the grid may have.
        max_gap: how far the ends of the runs may differ, in m.

    Returns:
        x (n,) in m, values (runs, n) in m in the survey's order of runs.

    Raises:
        SurveyError: no run, ends too different, or too few common points.
    """
    if not survey.runs:
        raise SurveyError(f"survey {survey.source}: has no run; allowed: at least one")
    starts, ends = [run.x[0] for run in survey.runs], [run.x[-1] for run in survey.runs]
    for what, at in (("start", starts), ("end", ends)):
        if max(at) - min(at) > max_gap:
            raise SurveyError(
                f"survey {survey.source}: the runs {what} between x = {min(at) * 1e3:.10g} mm and "
                f"{max(at) * 1e3:.10g} mm; allowed: within {max_gap * 1e3:.6g} mm (max_gap); was a run broken off?"
            )
    low, high = max(starts), min(ends)
    first = survey.runs[0].x
    # Half a step of room to the ends: triggers jitter, and two points a micrometre apart make the spline wild.
    room = 0.5 * float(np.median(np.diff(first)))
    grid = np.concatenate([[low], first[(first > low + room) & (first < high - room)], [high]])
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
