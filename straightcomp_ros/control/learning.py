"""Learning from stroke to stroke: iterative learning control over x, one table for each direction of motion.

The stage repeats its strokes, and most of the error repeats with them: the reversals of friction where r(x) turns, and
a law's lag. The error r − y of a pass is added to the reference of the next:

    c ← Q[(1 − f) c + γ (r − y)],   law's reference: r + c(x), with rates c' ẋ and c'' ẋ² + c' ẍ

(Bristow, Tharayil, Alleyne, A survey of iterative learning control, IEEE Control Systems 26(3), 2006). Because it
corrects the reference and not the current, the plant of the learning loop is the closed servo loop T, near 1 below its
bandwidth whatever the machine's mass, force and friction: |1 − γ T| < 1 there, and Q, a zero-phase low-pass, is zero
where T is unknown. γ falls as 1/(k + 2) with the updates k down to `gain`, which averages the noise of the passes
(Saab, IEEE Trans. Automatic Control 46(6), 2001).

Near rest, where the direction means nothing, the correction fades with the speed squared. A pass is not learned from if
the amplifier was off, samples were missing, its beginning was not seen, or the stage's motion was cut short: held,
ended or overridden. A pass that is cut short is corrected like any other: the reference keeps its rates.
"""

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.control.learned_table import LearnedTable, read_tables, write_tables
from straightcomp_ros.parameters.declaration import ParameterError, parameter
from straightcomp_ros.straightness.feedforward import restarted, updated

Reference = Sequence[float]
Job = Callable[[], None]

_REST = 1e-3
"""m/s below which the stage counts as standing: a pass ends."""
_STAGE_BANDWIDTH = 30.0
"""Hz, of the estimate of ẋ and ẍ."""
_SETTLED = 100
"""Samples after a restart until the estimated speed shows that the stage is at rest."""
_SHORTEST, _LONGEST = 200, 1_000_000
"""Samples of a pass that is learned from; a longer one is dropped."""
_JUMP = 0.01
"""m, more than any stage moves from sample to sample."""
_ORDER = 2
"""Of the low-pass, which runs forward and backward."""


@dataclass(frozen=True)
class LearningParameters:
    """Learning from stroke to stroke."""

    learn: bool = parameter(False, "Learn from stroke to stroke, and correct the law's reference by what was learned")
    file: str = parameter(
        "", "File of the learned correction: read at the start if it exists, written at the end; empty: memory only"
    )
    gain: float = parameter(0.3, "Fraction of a pass's error that is learned, once many were averaged", "(0, 1]")
    forgetting: float = parameter(0.01, "Fraction of the correction that each pass forgets", "[0, 0.5]")
    cutoff: float = parameter(
        35.0, "Errors up to this frequency are learned; below the servo's bandwidth", "(0, 1000] Hz"
    )
    limit: float = parameter(2e-6, "Largest correction of the reference", "(0, 0.0001] m")
    spacing: float = parameter(0.25e-3, "Distance of the nodes along x", "[1e-5, 0.01] m")
    fade_speed: float = parameter(0.02, "Speed of the stage below which the correction fades", "(0, 1] m/s")
    margin: float = parameter(
        0.05,
        "Fraction by which a pass's RMS error may exceed the best one's; beyond it the last update is taken back",
        "[0, 1]",
    )


class Learning:
    """Corrects the references of a stream of samples, and learns whenever a pass ends.

    A law is corrected only by what was learned with the same ``law``, by name. ``run`` runs the update at the end of a
    pass, some 3 ms of work, at once or soon; one after the other. ``tables`` are the learned corrections: forward at
    True, backward at False. ``cut`` is to be True while the stage's motion is cut short.

    Raises:
        LearningFileError: the file is refused.
        ParameterError: the cut-off is too near to half of the ``rate`` in Hz.
    """

    def __init__(
        self, parameters: LearningParameters, law: str, rate: float, run: Callable[[Job], None] = lambda job: job()
    ) -> None:
        self._run = run
        self._parameters, self._law = parameters, law
        if parameters.cutoff > 0.4 * rate:
            raise ParameterError(
                f"parameter 'learning.cutoff': {parameters.cutoff!r} Hz; allowed: <= {0.4 * rate:g} Hz at this rate"
            )
        # Not at the top of the file: scipy.signal takes a second to import, at the start of every node.
        from scipy.signal import butter

        self._low_pass = butter(_ORDER, parameters.cutoff, fs=rate, output="sos")
        self.tables = {forward: LearnedTable(parameters.spacing, parameters.margin) for forward in (True, False)}
        if parameters.file and Path(parameters.file).exists():
            read_tables(Path(parameters.file), law, self.tables)
        self._tracked = restarted(0.0)
        self._forward = True
        self.cut = False
        self.interrupt()

    def interrupt(self) -> None:
        """Drop the present pass, and correct nothing until the stage has stood still."""
        self._pass = array("d")
        self._samples, self._stood, self._spoiled = 0, False, False

    def step(self, stamp_ns: int, x: float, y: float, reference: Reference) -> Reference:
        """The law's reference (m, m/s, m/s²) for a sample: stamp, x and y in m, and the reference asked for."""
        if not abs(x - self._tracked.x) < _JUMP or not self._samples:
            self.interrupt()
            if math.isfinite(x):
                self._tracked = restarted(x)
                self._stamp_ns, self._samples = stamp_ns, 1
            return reference
        self._tracked = tracked = updated(_STAGE_BANDWIDTH, self._tracked, (stamp_ns - self._stamp_ns) * 1e-9, x)
        self._stamp_ns = stamp_ns
        self._samples += 1
        self._spoiled = self._spoiled or self.cut
        v = tracked.v
        forward = v > 0.0
        if -_REST < v < _REST or forward is not self._forward:
            self._end_pass()
            self._forward = forward
            self._stood = self._stood or self._samples > _SETTLED
            return reference
        if not self._stood:
            return reference
        speed = v if forward else -v
        weight, correction, slope, curvature = self.tables[forward].at(x, speed)
        if speed < self._parameters.fade_speed:
            weight *= (speed / self._parameters.fade_speed) ** 2
        r, r_dot, r_ddot = reference
        if len(self._pass) >= 5 * _LONGEST:
            self.interrupt()
            return reference
        self._pass.extend((x, r - y, weight, correction, speed))
        return (
            r + weight * correction,
            r_dot + weight * slope * v,
            r_ddot + weight * (curvature * v * v + slope * tracked.a),
        )

    def save(self) -> None:
        """Write the file that the parameters name, if they do; OSError if it cannot be written."""
        if self._parameters.file:
            write_tables(Path(self._parameters.file), self._law, self.tables)

    def counters(self) -> dict[str, object]:
        """Figures for the diagnostics."""
        return {"learned_forward": self.tables[True].updates, "learned_backward": self.tables[False].updates}

    def _end_pass(self) -> None:
        if len(self._pass) >= 5 * _SHORTEST and not self._spoiled:
            record = np.frombuffer(self._pass).reshape(-1, 5)
            self._run(partial(self._learn, self.tables[self._forward], record))
        if self._pass:
            self._pass = array("d")
        self._spoiled = False

    def _learn(self, table: LearnedTable, record: NDArray[np.float64]) -> None:
        from scipy.signal import sosfiltfilt

        x, error, weight, correction, speed = record.T.copy()
        chosen = self._parameters

        def wanted(gain: float) -> NDArray[np.float64]:
            kept = (1.0 - chosen.forgetting) * correction
            return np.asarray(sosfiltfilt(self._low_pass, kept + gain * error))

        gain = max(chosen.gain, 1.0 / (table.updates + 2.0))
        table.learn(x, error, weight, wanted, speed, gain, chosen.limit)
