"""A test signal that is added to the commands of a law, sample by sample: limited, of a given length, ending at zero.

Live, offline and replayed runs use it through `Servo.inject`. The law does not know of it, so that it stands at the
plant's input as a disturbance would. A bag tells both: the command, and as its equivalent plus its switching current
what the law had asked for.
"""

import math

import numpy as np
from numpy.typing import NDArray


class Injection:
    """Adds a table of currents to the commands, with a fade at its beginning and its end.

    Args:
        currents: (n,) control current in A to add, one for each sample.
        fade: samples over which the signal rises at the beginning, and falls at the end.
        limit: largest control current in A of command and signal together.
        travel: largest change of y − r in m since the signal's first sample; beyond it the signal fades out early.

    Raises:
        ValueError: a current is not finite, or the fades are longer than the signal.

    Attributes:
        stopped: why the signal ended early, empty if it did not.
        clipped: samples in which the limit cut the signal.
    """

    def __init__(self, currents: NDArray[np.float64], *, fade: int, limit: float, travel: float) -> None:
        if not np.isfinite(currents).all():
            raise ValueError("currents of an injection; allowed: finite numbers")
        if not 1 <= fade <= currents.size // 2:
            raise ValueError(
                f"fade of an injection, {fade} samples; allowed: 1 to {currents.size // 2}, half the signal"
            )
        self._currents: list[float] = currents.tolist()
        self._fade, self._limit, self._travel = fade, limit, travel
        self._next = 0
        self._origin = math.nan
        self._end = currents.size
        self.stopped = ""
        self.clipped = 0

    @property
    def finished(self) -> bool:
        """Whether nothing is added any more."""
        return self._next >= self._end

    def stop(self, reason: str) -> None:
        """End early, by the same fade."""
        if not self.stopped and not self.finished:
            self.stopped = reason
            self._end = min(self._end, self._next + self._fade)

    def step(self, command: float, error: float) -> float:
        """The command with the signal, A.

        Args:
            command: of the law for this sample, A.
            error: r − y in m.
        """
        if self.finished:
            return command
        if self._next == 0:
            self._origin = error
        moved = abs(error - self._origin)
        if not moved <= self._travel:
            self.stop(f"y − r changed by {moved * 1e6:.3g} µm; allowed: {self._travel * 1e6:.3g} µm")
        weight = min(1.0, (self._next + 1) / self._fade, (self._end - self._next - 1) / self._fade)
        asked = command + weight * self._currents[self._next]
        self._next += 1
        if abs(asked) <= self._limit:
            return asked
        self.clipped += 1
        return math.copysign(self._limit, asked)
