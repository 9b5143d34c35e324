"""A clock that never steps, in ns since the epoch: stamps must stay on the sampling grid."""

import time

_OFFSET_NS = time.time_ns() - time.monotonic_ns()


def now_ns() -> int:
    """Monotonic clock, set to the system time once, when the process starts."""
    return from_monotonic(time.monotonic_ns())


def from_monotonic(monotonic_ns: int) -> int:
    """Convert a reading of ``time.monotonic_ns`` to :func:`now_ns`."""
    return monotonic_ns + _OFFSET_NS
