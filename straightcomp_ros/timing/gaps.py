"""Counts missing samples by the stamps of those that arrived."""

_RESTART_NS = 10_000_000_000


class StampGaps:
    """Watches the stamps of a stream whose samples lie on a grid; the grid's period is the smallest step seen so far.

    A step backwards, or one longer than ten seconds, is a restart of the source and no loss.

    Attributes:
        lost: samples of the grid between two stamps seen that did not arrive.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._last_ns = -(2**63)
        self._period_ns = _RESTART_NS

    def see(self, stamp_ns: int) -> None:
        """Take the stamp of the next sample; a repeated sample changes nothing."""
        step = stamp_ns - self._last_ns
        if step == self._period_ns:
            self._last_ns = stamp_ns
            return
        if step == 0:
            return
        self._last_ns = stamp_ns
        if 0 < step < self._period_ns:
            self._period_ns = step
        elif 0 < step < _RESTART_NS:
            self.lost += round(step / self._period_ns) - 1
