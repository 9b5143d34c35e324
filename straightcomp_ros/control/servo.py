"""One control cycle: from a stream of samples to a law's commands. Live, offline and replayed runs share it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.law import Command, Law
from straightcomp_ros.control.learning import Learning
from straightcomp_ros.control.pairing import RUN_GAP_NS

AMPLIFIER_OFF = Command(0.0, math.nan, math.nan, 0.0, 0.0, math.nan, math.nan)
FADE_TIME = 0.1
"""s, of a crossfade from one law to another."""


class Crossfade:
    """Stands for a law while it is replaced by another, without a bump in the command.

    Both laws answer each sample, and the weight w of the new one grows by 1/n with each of n samples:

        i = (1 − w) i_old + w i_new,   |Δi| ≤ (1 − w) |Δi_old| + w |Δi_new| + |i_new − i_old| / n

    The command changes by no more than the laws' own steps and 1/n of their difference, which is at most twice the
    limit of the current. The old law may be a crossfade itself until that is over; the new one starts at the next
    sample, at rest. ``finished`` is called at the last of the ``samples`` n.
    """

    def __init__(self, old: Law | Crossfade, new: Law, samples: int, finished: Callable[[Crossfade], None]) -> None:
        self._old, self.new, self._samples, self._finished = old, new, samples, finished
        self._done = 0

    @property
    def over(self) -> bool:
        """Whether the new law acts alone."""
        return self._done >= self._samples

    def reset(self, y: float) -> None:
        """Start the new law at rest at ``y`` (m), and end the fade."""
        self.new.reset(y)
        self._finished(self)

    def excited(self) -> None:
        """As of `Law.excited`: the old law does not live to conclude anything."""
        self.new.excited()

    def step(self, y: float, *others: float) -> Command:
        """The new law's answer with the blended current; arguments as of `Law.step`."""
        if not self._done:
            self.new.reset(y)
        self._done += 1
        weight = self._done / self._samples
        if isinstance(self._old, Crossfade) and self._old.over:
            # Otherwise a law that changes more often than a fade takes would cost ever more time.
            self._old = self._old.new
        before, after = self._old.step(y, *others), self.new.step(y, *others)
        if self.over:
            self._finished(self)
        return after._replace(current=before.current + weight * (after.current - before.current))


class Servo:
    """Steps a law once for each sample, in the order of the stamps.

    A repeated sample gets the same answer again and changes nothing. While the amplifier is off the law is kept reset,
    so that nothing is integrated that cannot act. After a gap of more than :data:`RUN_GAP_NS` between two samples the
    law starts anew. ``learning`` corrects the law's reference by what earlier strokes left. ``running`` says whether
    the newest sample found the amplifier on.
    """

    def __init__(self, law: Law, learning: Learning | None = None) -> None:
        self._law: Law | Crossfade = law
        self._learning = learning
        self._stamp_ns: int | None = None
        self._answer = AMPLIFIER_OFF
        self.running = False
        self._injection: Injection | None = None

    def inject(self, injection: Injection) -> None:
        """Add a test signal to the commands from the next sample on, in place of one that is running."""
        self._injection = injection

    def change(self, law: Law, samples: int) -> None:
        """Replace the law, by a crossfade of ``samples`` while one acts, otherwise at once."""
        self._law = Crossfade(self._law, law, samples, self._end_fade) if self.running else law

    def _end_fade(self, fade: Crossfade) -> None:
        # After another change this fade is the old law of a newer one, and stays it.
        if self._law is fade:
            self._law = fade.new

    def step(
        self, stamp_ns: int, y: float, coil_current: float, reference: Sequence[float], x: float = math.nan
    ) -> Command | None:
        """Answer one sample, or None for a sample older than the last one, or with non-finite numbers.

        ``y`` is the encoder reading in m, ``coil_current`` the measured control current in A, NaN while the amplifier
        is off, ``reference`` r in m, ṙ in m/s and r̈ in m/s²; ``x`` in m, of the stage, is for learning alone.
        """
        last = self._stamp_ns
        if last is not None and stamp_ns <= last and last - stamp_ns <= RUN_GAP_NS:
            return self._answer if stamp_ns == last else None
        r, r_dot, r_ddot = reference
        if not math.isfinite(y + r + r_dot + r_ddot):
            return None
        gap = last is not None and abs(stamp_ns - last) > RUN_GAP_NS
        self._stamp_ns = stamp_ns
        amplifier_on = not math.isnan(coil_current)
        if self._injection is not None and (gap or not amplifier_on):
            self._injection.stop("the amplifier was off, or samples were missing")
            self._injection = None
        if self._learning is not None and (gap or not (self.running and amplifier_on)):
            self._learning.interrupt()
        if not amplifier_on:
            self._answer = AMPLIFIER_OFF._replace(error=r - y)
        else:
            if gap or not self.running:
                self._law.reset(y)
            if self._injection is not None and not self._injection.finished:
                self._law.excited()
                if self._learning is not None:
                    self._learning.spoil()
            if self._learning is None:
                self._answer = self._law.step(y, r, r_dot, r_ddot, coil_current)
            else:
                r_law, r_dot, r_ddot = self._learning.step(stamp_ns, x, y, reference)
                self._answer = self._law.step(y, r_law, r_dot, r_ddot, coil_current)._replace(error=r - y)
            if self._injection is not None:
                self._answer = self._answer._replace(current=self._injection.step(self._answer.current, r - y))
        self.running = amplifier_on
        return self._answer
