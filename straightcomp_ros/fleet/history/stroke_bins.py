"""Values of a stroke over x, as means in bins whose edges are the same for all strokes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.fleet.history.stroke_row import BIN_MM

_WIDTH = 1e-3 * BIN_MM


@dataclass(frozen=True, eq=False)
class Bins:
    """``count`` bins, the first from x = ``from_mm`` on; ``place`` (n,) is the bin of each sample, beyond 0 to
    ``count`` − 1 for the samples outside."""

    from_mm: int
    count: int
    place: NDArray[np.int64]

    def means(self, values: NDArray[np.float64]) -> list[float | None]:
        """Mean of ``values`` (n,) in each bin, without those that are NaN; None for a bin without a value."""
        inside = (self.place >= 0) & (self.place < self.count) & np.isfinite(values)
        place = self.place[inside]
        samples = np.bincount(place, minlength=self.count)
        sums = np.bincount(place, values[inside], minlength=self.count)
        return [total / n if n else None for total, n in zip(sums.tolist(), samples.tolist(), strict=True)]


def bins_over(x: NDArray[np.float64]) -> Bins:
    """The bins of which a stroke over ``x`` (n,) in m covers at least half: a stroke that begins a count before an edge
    would otherwise have a bin of some samples at rest."""
    first = math.ceil(float(x.min()) / _WIDTH - 0.5)
    last = math.floor(float(x.max()) / _WIDTH + 0.5)
    return Bins(first * BIN_MM, max(last - first, 0), np.floor(x / _WIDTH).astype(np.int64) - first)
