"""One control cycle: what stands between a stream of samples and a law. Live, offline and replayed runs share it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.law_crossfade import Crossfade, Stepped
from straightcomp_ros.control.learning import Learning

AMPLIFIER_OFF = Command(0.0, math.nan, math.nan, 0.0, 0.0, math.nan, math.nan)


class Servo:
    """Steps a law once for each sample, in the order of the stamps.

    A repeated sample gets the same answer again and changes nothing. While the amplifier is off the law
    is kept reset, so that nothing is integrated that cannot act. After a gap longer than ``restart_gap_ns``
    the law starts anew.

    Args:
        law: control law.
        restart_gap_ns: gap between two samples, in ns, after which old values say nothing.
        learning: corrects the law's reference by what earlier strokes left; None for none.
    """

    def __init__(self, law: Law, restart_gap_ns: int = 20_000_000, learning: Learning | None = None) -> None:
        self._law: Stepped = law
        self._learning = learning
        self._restart_gap_ns = restart_gap_ns
        self._stamp_ns: int | None = None
        self._answer = AMPLIFIER_OFF
        self._running = False

    def change(self, law: Law, samples: int) -> None:
        """Go over to another law within so many samples, without a bump; at once where none is acting."""
        if self._running:
            self._law = Crossfade(self._law, law, samples, self._end_fade)
        else:
            self._law = law

    def _end_fade(self, fade: Crossfade) -> None:
        # Another change may have come meanwhile: this fade is the other one's old law then, and stays it.
        if self._law is fade:
            self._law = fade.new

    def step(
        self, stamp_ns: int, y: float, coil_current: float, reference: Sequence[float], x: float = math.nan
    ) -> Command | None:
        """Answer one sample, or None for a sample older than the last one, or with non-finite numbers.

        Args:
            stamp_ns: the sample's stamp.
            y: encoder reading, m.
            coil_current: measured control current, A; NaN while the amplifier is off.
            reference: r in m, ṙ in m/s and r̈ in m/s² for the same sample.
            x: the stage's position, m; only learning asks for it.
        """
        last = self._stamp_ns
        if last is not None and stamp_ns <= last and last - stamp_ns <= self._restart_gap_ns:
            return self._answer if stamp_ns == last else None
        r, r_dot, r_ddot = reference
        if not math.isfinite(y + r + r_dot + r_ddot):
            return None
        gap = last is not None and abs(stamp_ns - last) > self._restart_gap_ns
        self._stamp_ns = stamp_ns
        if math.isnan(coil_current):
            self._running = False
            if self._learning is not None:
                self._learning.interrupt()
            self._answer = AMPLIFIER_OFF._replace(error=r - y)
            return self._answer
        if not self._running or gap:
            self._law.reset(y)
            self._running = True
            if self._learning is not None:
                self._learning.interrupt()
        if self._learning is None:
            self._answer = self._law.step(y, r, r_dot, r_ddot, coil_current)
        else:
            r_law, r_dot, r_ddot = self._learning.step(stamp_ns, x, y, reference)
            self._answer = self._law.step(y, r_law, r_dot, r_ddot, coil_current)._replace(error=r - y)
        return self._answer
