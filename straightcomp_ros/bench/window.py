"""The measured part of a run: begins and ends between reports of progress, with looks at the processes in between."""

from collections.abc import Callable, Mapping

import numpy as np

from straightcomp_ros.bench.processes import Usage


class Window:
    """Looks at the processes at the right times; call it repeatedly while the graph runs.

    Args:
        look: returns the current usage.
        settle: time in s from the first call to the begin.
        seconds: from begin to end.
        interval: time in s between looks.
    """

    def __init__(self, look: Callable[[], Usage], *, settle: float, seconds: float, interval: float = 10.0) -> None:
        self._look = look
        self._settle, self._seconds, self._interval = settle, seconds, interval
        self._begin: float | None = None
        self._next = 0.0
        self.looks: list[Usage] = []
        self.finished = False

    def __call__(self, now: float) -> None:
        """Look if it is time to at ``now``, in s of a monotonic clock."""
        if self._begin is None:
            self._begin = self._next = now + self._settle
        over = now >= self._begin + self._seconds
        if not self.finished and (over or now >= self._next):
            self.looks.append(self._look())
            self._next += self._interval
            self.finished = over


def growth_mb_per_hour(looks: list[Usage]) -> Mapping[str, float]:
    """Slope of each process's memory over all looks (least squares), MB/h; NaN with fewer than two."""
    if len(looks) < 2:
        return {name: float("nan") for look in looks[:1] for name in look.rss_mb}
    hours = np.array([look.time_ns - looks[0].time_ns for look in looks]) / 3.6e12
    hours -= hours.mean()
    return {
        name: float(hours @ np.array([look.rss_mb[name] for look in looks]) / (hours @ hours))
        for name in looks[0].rss_mb
    }
