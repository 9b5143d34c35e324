"""The error of each movement of the stage, computed while its samples arrive."""

import math
from collections import deque

_LOOK_BACK_NS = 100_000_000
_STILL_M = 50e-6
"""Smaller distances in the look-back time count as standstill: 0.5 mm/s, far above the encoder's noise."""


class StrokeErrors:
    """Peak-to-peak error over each movement, from the streams of position and error.

    The streams need not be synchronous: a tenth of a second at either end of a movement may be counted or not.
    """

    def __init__(self) -> None:
        self.still = True  # the stage is at rest
        self.last_pp = math.nan  # error over the last finished movement, m
        self.finished = 0  # movements so far
        self._positions: deque[tuple[int, float]] = deque()
        self._low, self._high = math.inf, -math.inf

    def add_position(self, stamp_ns: int, x: float) -> None:
        """Add the stage's position ``x`` (m) at ``stamp_ns``."""
        positions = self._positions
        if positions and stamp_ns <= positions[-1][0]:
            # The source restarted: its earlier positions are meaningless now.
            positions.clear()
        positions.append((stamp_ns, x))
        while stamp_ns - positions[0][0] > _LOOK_BACK_NS:
            positions.popleft()
        still = abs(x - positions[0][1]) < _STILL_M
        if still and not self.still:
            self._finish()
        self.still = still

    def add_error(self, error: float) -> None:
        """Add a compensation error in m."""
        if not self.still and math.isfinite(error):
            self._low, self._high = min(self._low, error), max(self._high, error)

    def _finish(self) -> None:
        self.finished += 1
        self.last_pp = self._high - self._low if self._high >= self._low else math.nan
        self._low, self._high = math.inf, -math.inf
