"""Level of a node's diagnostics, with hysteresis, so that it does not change every second."""

import enum

_CLEAN_REPORTS = 5
_OVERRUN_SHARE = 0.01
_STALLED_MS = 10
"""Of one second; shorter stalls happen on every desktop."""


class Level(enum.IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Levels:
    """The level of each report of one node.

    A report with lost samples, with overruns in more than 1 % of the samples, or with stalls of more than 10 ms, is a
    warning. So are the next ones
    until five in a row had neither. An error is reported while it lasts, and warnings follow it in the same way.
    """

    def __init__(self) -> None:
        self._lost = self._overruns = self._stalled_ms = self._samples = 0
        self._clean = _CLEAN_REPORTS

    def next(self, samples: int, lost: int, overruns: int, stalled_ms: int, error: bool) -> tuple[Level, str]:
        """Level and text of a report, from the node's counters since its start."""
        new_lost, new_overruns = lost - self._lost, overruns - self._overruns
        new_stalled_ms = stalled_ms - self._stalled_ms
        late = new_overruns > _OVERRUN_SHARE * max(samples - self._samples, 1)
        stalled = new_stalled_ms > _STALLED_MS
        self._samples, self._lost, self._overruns, self._stalled_ms = samples, lost, overruns, stalled_ms
        self._clean = 0 if new_lost > 0 or late or stalled or error else self._clean + 1
        if error:
            return Level.ERROR, ""
        if new_lost > 0:
            return Level.WARN, f"{new_lost} samples lost in the last second"
        if late:
            return Level.WARN, f"{new_overruns} overruns in the last second"
        if stalled:
            return Level.WARN, f"the host held the loop up for {new_stalled_ms} ms in the last second"
        if self._clean < _CLEAN_REPORTS:
            return Level.WARN, "running again; it had a problem in the last seconds"
        return Level.OK, "running"
