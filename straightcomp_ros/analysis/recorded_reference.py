"""The map as a run used it: the references that were recorded, over x."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from straightcomp_ros.analysis.record import StrokeRecord


class RecordedReference:
    """r(x) between the recorded samples, by straight lines.

    At 0.3 m/s and 2 kHz these are h = 0.15 mm apart; a curvature r'' of 1e-3 1/m then makes h²r''/8 = 3 pm. This is
    what the servo was really given, and needs no survey file.
    """

    def __init__(self, record: StrokeRecord) -> None:
        finite = np.isfinite(record.x) & np.isfinite(record.r)
        self._x, rows = np.unique(record.x[finite], return_index=True)
        self._r = record.r[finite][rows]

    def evaluate(self, x: ArrayLike) -> tuple[NDArray[np.float64]]:
        """r in m at x in m; beyond the recorded positions that of the nearest."""
        return (np.asarray(np.interp(np.asarray(x, np.float64), self._x, self._r)),)

    def deviations(self, x: ArrayLike) -> NDArray[np.float64]:
        """δ in m, up to a constant."""
        return -self.evaluate(x)[0]
