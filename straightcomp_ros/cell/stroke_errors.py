"""The error of each movement of the stage, as it comes in."""

import math
from collections import deque

_LOOK_BACK_NS = 100_000_000
_STILL_M = 50e-6
"""Way in the look-back time below which the stage stands: 0.5 mm/s, far above the encoder's noise."""


class StrokeErrors:
    """Peak-to-peak error over each movement, from the streams of position and error.

    The two streams need not be in step: at the ends of a movement a tenth of a second counts to neither or either side.
    """

    def __init__(self) -> None:
        self.still = True  # the stage stands
        self.last_pp = math.nan  # error over the last finished movement, m
        self.finished = 0  # movements so far
        self._positions: deque[tuple[int, float]] = deque()
        self._low, self._high = math.inf, -math.inf

    def add_position(self, stamp_ns: int, x: float) -> None:
        """The stage was at ``x`` (m) at ``stamp_ns``."""
        positions = self._positions
        if positions and stamp_ns <= positions[-1][0]:
            # The source was started anew: what it said before says nothing of now.
            positions.clear()
        positions.append((stamp_ns, x))
        while stamp_ns - positions[0][0] > _LOOK_BACK_NS:
            positions.popleft()
        still = abs(x - positions[0][1]) < _STILL_M
        if still and not self.still:
            self._finish()
        self.still = still

    def add_error(self, error: float) -> None:
        """The compensation error was ``error`` (m)."""
        if not self.still and math.isfinite(error):
            self._low, self._high = min(self._low, error), max(self._high, error)

    def _finish(self) -> None:
        self.finished += 1
        self.last_pp = self._high - self._low if self._high >= self._low else math.nan
        self._low, self._high = math.inf, -math.inf
