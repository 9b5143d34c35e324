"""Keeps a loop's wake-up just behind the arrival of what it waits for.

Two free-running 2 kHz loops slide past each other: the second finds a message anywhere from 0 to 500 µs old. The
lock shifts the wake-up, a little in each period, until messages wait for a short set time only.
"""

from __future__ import annotations

_GAIN = 0.02
_GAIN_TOO_EARLY = 0.1


class PhaseLock:
    """First-order phase-locked loop on the time that messages wait to be fetched.

    Waking too early costs a whole period, waking too late costs what it is late: the correction for the first
    is the stronger one, so that with jittering arrivals few messages are missed.

    Args:
        period_ns: length of a period.
        target_ns: how long a message is to wait.
    """

    def __init__(self, period_ns: int, target_ns: int) -> None:
        self._period_ns = period_ns
        self._target_ns = target_ns
        self.error_ns = 0.0
        """How much later than meant the newest message was fetched; negative: it came after the wake-up before."""

    def shift_ns(self, waited_ns: int) -> int:
        """How much later the next wake-up must be, after a message that had waited ``waited_ns``."""
        error = (waited_ns - self._target_ns) % self._period_ns
        if error > self._period_ns // 2:
            error -= self._period_ns
        self.error_ns = float(error)
        return -round((_GAIN if error > 0 else _GAIN_TOO_EARLY) * error)
