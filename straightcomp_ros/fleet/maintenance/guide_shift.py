"""How far, and where, the guide has moved since the baseline, from the profiles of the displacement sensor.

A parabola over the whole length is left out: the sensor's straight edge may be put down anew, and guides bow with the
temperature of what they are mounted on. What is left is local.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.fleet.history.stroke_row import BIN_MM
from straightcomp_ros.fleet.maintenance.level_change import BASELINE

Array = NDArray[np.float64]
_SMOOTH = 5
"""Bins over which a profile is averaged: guides move over centimetres, readings scatter from bin to bin."""
_DEGREE = 2
_EDGE = 0.3
"""Fraction of the largest change at which the moved place ends."""


class Place(NamedTuple):
    """A stretch of the guide in mm."""

    first: int
    last: int


def guide_shifts(profiles: Array, x: Array) -> Array:
    """Change (n, m) in µm of ``profiles`` (n, m) since their baseline, smooth and beside a parabola; NaN without a
    profile. ``x`` (m,) in m."""
    found = np.full(profiles.shape, np.nan)
    inside = np.isfinite(profiles).any(axis=0)
    days = np.flatnonzero(np.isfinite(profiles[:, inside]).all(axis=1)) if inside.any() else np.zeros(0, np.intp)
    if not days.size:
        return found
    known = profiles[np.ix_(days, inside)]
    change = known - known[:BASELINE].mean(axis=0)
    at = x[inside]
    if at.size <= _DEGREE:
        return found
    powers = np.vander(at - at.mean(), _DEGREE + 1)
    local = change - (powers @ np.linalg.lstsq(powers, change.T, rcond=None)[0]).T
    kernel = np.ones(min(_SMOOTH, at.size))
    # At the ends over the bins that are there.
    weight = np.convolve(np.ones(at.size), kernel, mode="same")
    found[np.ix_(days, inside)] = [np.convolve(one, kernel, mode="same") / weight for one in local]
    return found


def moved_place(shift: Array, x: Array) -> Place | None:
    """Where a change ``shift`` (m,) in µm over ``x`` (m,) in m is largest, to where it falls below a third of that."""
    if not np.isfinite(shift).any():
        return None
    # The parabola through a guide that moved in one place lies off zero elsewhere.
    size = np.abs(shift - np.nanmedian(shift))
    peak = int(np.nanargmax(size))
    large = np.nan_to_num(size) > _EDGE * size[peak]
    first = last = peak
    while first > 0 and large[first - 1]:
        first -= 1
    while last < size.size - 1 and large[last + 1]:
        last += 1
    low, high = (round(float(x[place]) * 1e3 + half) for place, half in ((first, -BIN_MM / 2), (last, BIN_MM / 2)))
    return Place(low, high)
