"""The references of a whole cycle at once, bit for bit those of `Feedforward.step`, by the same functions."""

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.pairing import extrapolated
from straightcomp_ros.model.compiled import compiled
from straightcomp_ros.model.converters import nearest_count
from straightcomp_ros.straightness.feedforward import FeedforwardParameters, continues, rates, restarted, updated
from straightcomp_ros.straightness.guide_map import StraightnessMap


@compiled
def readings(resolution: float, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Readings of an encoder of ``resolution`` (m) at ``positions``, (n,) in m."""
    seen = np.empty_like(positions)
    for k in range(positions.size):
        seen[k] = nearest_count(resolution, positions[k])
    return seen


@compiled
def _follow(bandwidth, gap_ns, max_speed, stamps, x, v, a):  # type: ignore[no-untyped-def]
    tracked = restarted(x[0])
    v[0], a[0] = tracked.v, tracked.a
    for k in range(1, x.size):
        elapsed = stamps[k] - stamps[k - 1]
        if continues(gap_ns, max_speed, elapsed, x[k] - x[k - 1]):
            tracked = updated(bandwidth, tracked, elapsed * 1e-9, x[k])
        else:
            tracked = restarted(x[k])
        v[k], a[k] = tracked.v, tracked.a


def references(
    straightness: StraightnessMap,
    parameters: FeedforwardParameters,
    highest_speed: float,
    stamps: NDArray[np.int64],
    x: NDArray[np.float64],
) -> NDArray[np.float64]:
    """r in m, ṙ in m/s and r̈ in m/s², (n, 3), at ``stamps``, (n,) in ns, all different, and ``x``, (n,) in m.

    ``highest_speed`` is that which the stage cannot reach, m/s.
    """
    v, a = np.empty_like(x), np.empty_like(x)
    _follow(parameters.bandwidth, parameters.restart_gap_ns, highest_speed, stamps, x, v, a)
    r, slope, curvature = straightness.evaluate(x)
    return np.column_stack([r, *rates(slope, curvature, v, a)])


def served(references: NDArray[np.float64], stamps: NDArray[np.int64], lead_ns: int) -> NDArray[np.float64]:
    """The references as `Pairing` serves them, (n, 3): extrapolated from those of ``lead_ns`` before each sample."""
    earlier = np.searchsorted(stamps, np.maximum(stamps - lead_ns, stamps[0]), side="right") - 1
    return np.column_stack(extrapolated(*references[earlier].T, (stamps - stamps[earlier]) * 1e-9))
