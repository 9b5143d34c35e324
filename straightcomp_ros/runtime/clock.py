"""Time that never steps, in ns since the epoch: for stamps that must stay on the sampling grid."""

import time

_OFFSET_NS = time.time_ns() - time.monotonic_ns()


def now_ns() -> int:
    """Monotonic clock, set to the system's time once, when the process started."""
    return from_monotonic(time.monotonic_ns())


def from_monotonic(monotonic_ns: int) -> int:
    """The same for a reading of ``time.monotonic_ns``."""
    return monotonic_ns + _OFFSET_NS
