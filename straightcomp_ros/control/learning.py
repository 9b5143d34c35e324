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

The correction is a uniform cubic B-spline: it has two continuous derivatives, so that the law's rates can be corrected
along with the reference, and a lookup needs four coefficients. Each coefficient is the average of the wanted correction
around its node; interpolating these averages would only add back the noise between two nodes.

For each node the table keeps the mean square error of the best pass, that without a correction, and the stage's speed.
Comparing node by node lets strokes of different lengths share one table. A correction learned at one speed says little
of another (a lag grows with it, and c'' ẋ² with its square): it fades where the speed differs, and nodes that a pass
crosses at another speed start anew.

The tables of both directions are kept in a CSV file, one line for each node of x, forward and backward side by side.
"""

import math
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.parameters.declaration import ParameterError, parameter
from straightcomp_ros.parameters.output_files import check_writable, write_whole
from straightcomp_ros.parameters.yaml_text import bounded_lines, number_rows
from straightcomp_ros.straightness.feedforward import restarted, updated

Array = NDArray[np.float64]

_ENDS = 4
"""Nodes beyond the outermost visited ones, over which the spline fades out."""
_SAME_SPEED, _OTHER_SPEED = 0.1, 0.3
"""Relative differences of the speed up to which the correction is applied in full, and from which it is not."""
_LEAST_COMMON = 100
"""Fewest samples at nodes seen before for which two passes are compared."""
_MANY = 100
"""Updates assumed of a table that was read from a file, so that it is updated with the final gain."""
COEFFICIENT, BEST, BEST_SQUARE, BARE_SQUARE, SPEED = range(5)
"""Rows of a table's nodes."""
_UNKNOWN = np.array([[0.0], [0.0], [math.nan], [math.nan], [0.0]])
"""A node that was not visited."""

_QUANTITIES = {"correction_m": 1e-3, "speed_m_per_s": 100.0, "rms_m": 1e-3, "bare_rms_m": 1e-3}
_COLUMNS = {"x_m": 1000.0}
_COLUMNS |= {f"{way}_{name}": most for way in ("forward", "backward") for name, most in _QUANTITIES.items()}
"""Of a file, and the largest magnitude of each: a larger one is in the wrong unit."""
_MEASURED = [name for name in _COLUMNS if name.endswith("rms_m")]
"""Columns that are empty where nothing was measured."""
_LAW = "# law:"


class LearnedTable:
    """Correction over x for one direction of motion.

    Args:
        spacing: of the nodes, m; node k lies at k times the spacing.
        margin: fraction by which the RMS error of two like passes may differ by chance.

    Attributes:
        first: number of the first node.
        nodes: (5, n): coefficient of the spline in m; that of the best pass so far in m; mean square of r − y in that
            pass, and without any correction, in m², NaN at nodes that were not visited; speed of the stage when it was
            learned in m/s, 0 at nodes that were not visited.
        updates: number of updates.
        caution: factor of the gain, halved when an update increased the error, doubled up to 1 when one reduced it.
        tried: whether the coefficients differ from those of the best pass.
    """

    def __init__(self, spacing: float, margin: float) -> None:
        self.spacing = spacing
        self._margin = margin
        self._factors = (1.0 / spacing, 0.5 / spacing, 1.0 / (spacing * spacing))
        self.first = 0
        self.clear()
        self._publish()

    def clear(self) -> None:
        """Forget everything."""
        self.nodes = np.zeros((5, 0))
        self.updates, self.caution, self.tried = 0, 1.0, False

    def restore(self, first: int, best: Array, best_square: Array, bare_square: Array, speed: Array) -> None:
        """Take the rows of a saved table; (n,) each, from node ``first`` on."""
        self.first = first
        self.nodes = np.array([best, best, best_square, bare_square, speed])
        self.updates, self.caution, self.tried = _MANY, 1.0, False
        self._publish()

    def bound(self, limit: float) -> None:
        """Bring the coefficients within ±``limit`` in m, those of the best pass too."""
        rows = self.nodes[[COEFFICIENT, BEST]]
        self.nodes[[COEFFICIENT, BEST]] = np.clip(rows, -limit, limit)
        self._publish()

    def between(self, first: int, end: int) -> Array:
        """``nodes`` from ``first`` to before ``end``, which are all of the table's or more."""
        if not self.nodes.size:
            return np.repeat(_UNKNOWN, end - first, axis=1)
        before, after = self.first - first, end - self.first - self.nodes.shape[1]
        unknown = [np.repeat(_UNKNOWN, count, axis=1) for count in (before, after)]
        return np.concatenate([unknown[0], self.nodes, unknown[1]], axis=1)

    def at(self, x: float, speed: float) -> tuple[float, float, float, float]:
        """Weight of the correction at a speed in m/s, the correction in m, and its first two derivatives by x in m/m
        and 1/m; no correction outside of the table."""
        first, end, plain, plain_speed = self._lookup
        per_metre, half_per_metre, per_metre_squared = self._factors
        u = x * per_metre - first
        i = int(u)
        if not 1 <= i < end:
            return 1.0, 0.0, 0.0, 0.0
        learned = plain_speed[i]
        away = abs(speed - learned)
        weight = 1.0
        if away > _SAME_SPEED * learned > 0.0:
            weight = max(0.0, (_OTHER_SPEED - away / learned) / (_OTHER_SPEED - _SAME_SPEED))
        t = u - i
        s = 1.0 - t
        b0, b1, b2, b3 = plain[i - 1 : i + 3]
        tt, ss = t * t, s * s
        return (
            weight,
            (b0 * ss * s + b1 * (3.0 * tt * (t - 2.0) + 4.0) + b2 * (3.0 * ss * (s - 2.0) + 4.0) + b3 * tt * t) / 6.0,
            (b1 * t * (3.0 * t - 4.0) - b2 * s * (3.0 * s - 4.0) + b3 * tt - b0 * ss) * half_per_metre,
            (b0 * s + b1 * (3.0 * t - 2.0) + b2 * (3.0 * s - 2.0) + b3 * t) * per_metre_squared,
        )

    def learn(
        self,
        x: Array,
        error: Array,
        weight: Array,
        wanted: Callable[[float], Array],
        speed: Array,
        gain: float,
        limit: float,
    ) -> None:
        """Compare a pass with the best one, and update the table if it was not worse.

        Of its samples, (n,): ``x`` and ``error``, r − y, in m, ``weight`` of the correction as applied, ``speed`` of
        the stage in m/s; ``wanted(gain)`` is the correction for the next pass at these, m. ``gain`` is that of the
        learning before ``caution``, ``limit`` the largest coefficient in m.
        """
        low = math.floor(float(x.min()) / self.spacing) - _ENDS
        end = math.ceil(float(x.max()) / self.spacing) + _ENDS + 1
        if self.nodes.size:
            low, end = min(low, self.first), max(end, self.first + self.nodes.shape[1])
        self.nodes, self.first = self.between(low, end), low
        node = np.floor(x / self.spacing + 0.5).astype(np.intp) - self.first
        visits = np.bincount(node, minlength=end - low)
        with np.errstate(invalid="ignore"):
            square = np.bincount(node, error * error, visits.size) / visits
            passed_at = np.bincount(node, speed, visits.size) / visits
        other = np.abs(passed_at - self.nodes[SPEED]) > _OTHER_SPEED * self.nodes[SPEED]
        self.nodes[:, other & (self.nodes[SPEED] > 0.0)] = _UNKNOWN
        self.nodes[SPEED, other] = passed_at[other]
        if self._accepted(visits, square):
            values = wanted(gain * self.caution)
            weights = np.bincount(node, weight, visits.size)
            known = np.flatnonzero(weights > 0.0)
            if known.size:
                means = np.bincount(node, weight * values, visits.size)[known] / weights[known]
                # At high speed a node may lie between two samples.
                between = np.arange(known[0], known[-1] + 1)
                self.nodes[COEFFICIENT, between] = np.clip(np.interp(between, known, means), -limit, limit)
                self.updates += 1
                self.tried = True
        self._publish()

    def _accepted(self, visits: NDArray[np.intp], square: Array) -> bool:
        """Whether a pass is good enough to learn from; if not, the table goes back to the best pass."""
        coefficients, best, best_square, bare_square, _ = self.nodes
        now, least = _sums(visits, square, best_square)
        visited = visits > 0
        if now > least * (1.0 + self._margin) ** 2:
            if self.tried:
                coefficients[:] = best
                self.tried = False
                self.caution *= 0.5
                return False
            # The machine has changed: the best pass counts no more. The table may still be better than none.
            now, bare = _sums(visits, square, bare_square)
            if now > bare:
                self.clear()
                return False
            best_square[visited] = square[visited]
        elif now <= least:
            if self.tried:
                self.caution = min(1.0, 2.0 * self.caution)
            # Only where the stage was: elsewhere the last update is not proved yet.
            proved = slice(*(np.flatnonzero(visited)[[0, -1]] + (0, 1)))
            best[proved] = coefficients[proved]
            self.tried = not np.array_equal(best, coefficients)
            best_square[visited] = square[visited]
        for kept in (best_square, bare_square):
            new = visited & np.isnan(kept)
            kept[new] = square[new]
        return True

    def _publish(self) -> None:
        """Lists for :meth:`at`, whose time would be mostly NumPy's overhead; replaced at once: it may run in another
        thread."""
        self._lookup = (
            self.first,
            self.nodes.shape[1] - 2,
            self.nodes[COEFFICIENT].tolist(),
            self.nodes[SPEED].tolist(),
        )


def _sums(visits: NDArray[np.intp], square: Array, other: Array) -> tuple[float, float]:
    """Sums of squares of a pass and of another one over the nodes known of both, weighted by the visits of the first;
    zeros where there is too little to compare."""
    common = (visits > 0) & np.isfinite(other)
    if visits[common].sum() < _LEAST_COMMON:
        return 0.0, 0.0
    return float(visits[common] @ square[common]), float(visits[common] @ other[common])


def write_tables(path: Path, law: str, tables: Mapping[bool, LearnedTable]) -> None:
    """Write the tables of the law named ``law``, forward at True and backward at False, of the same spacing: with what
    the last pass taught, since a run of one pass would else teach nothing. If that was no good, the first pass of the
    next run is worse than the best, and then counts as one on another machine.

    The file is replaced in one step: an interruption leaves the old one. No empty file is written. OSError if it cannot
    be.
    """
    spacing = tables[True].spacing
    filled = [table for table in tables.values() if table.nodes.size]
    if not filled:
        return
    first = min(table.first for table in filled)
    last = max(table.first + table.nodes.shape[1] for table in filled)
    columns = []
    for forward in (True, False):
        nodes = tables[forward].between(first, last)
        columns += [nodes[COEFFICIENT], nodes[SPEED], np.sqrt(nodes[BEST_SQUARE]), np.sqrt(nodes[BARE_SQUARE])]
    lines = [
        "# Correction of the reference learned by straightcomp, as coefficients of a uniform cubic B-spline over x.",
        "# rms: of r - y in the best pass; bare_rms: without a correction; empty where nothing was learned.",
        f"{_LAW} {law}",
        ",".join(_COLUMNS),
    ]
    for node, row in zip(range(first, last), np.column_stack(columns).tolist(), strict=True):
        cells = ("" if math.isnan(value) else f"{value:.6g}" for value in row)
        lines.append(f"{node * spacing:.9g}," + ",".join(cells))
    write_whole(path, "\n".join(lines) + "\n")


def read_tables(path: Path, law: str, tables: Mapping[bool, LearnedTable]) -> None:
    """Read what :func:`write_tables` wrote into ``tables``, for the law named ``law``.

    ParameterError if it cannot be read, was learned with another law or spacing, or is damaged; the message names file,
    value and what is allowed.
    """
    file = f"learning file {path}"
    lines = bounded_lines(path, file)
    learned_with = next((line[len(_LAW) :].strip() for line in lines if line.startswith(_LAW)), None)
    if learned_with != law:
        raise ParameterError(f"{file}: learned with law {learned_with!r}; allowed: '{_LAW} {law}', the law that runs")
    numbers = number_rows(lines, file, _COLUMNS, blank=_MEASURED)
    if not len(numbers):
        raise ParameterError(f"{file}: has a header but no rows; allowed: at least one")
    x, spacing = numbers[:, 0], tables[True].spacing
    first = round(float(x[0]) / spacing)
    expected = (first + np.arange(x.size)) * spacing
    wrong = np.abs(x - expected) > 1e-3 * spacing
    if wrong.any():
        at = int(wrong.argmax())
        raise ParameterError(
            f"{file}: x_m {float(x[at]):.9g}; allowed: {float(expected[at]):.9g}, "
            f"nodes {spacing:g} m apart without a gap (learning.spacing)"
        )
    for forward, columns in ((True, numbers[:, 1:5]), (False, numbers[:, 5:9])):
        correction, speed, rms, bare_rms = columns.T
        tables[forward].restore(first, correction, rms * rms, bare_rms * bare_rms, speed)


Reference = Sequence[float]
Job = Callable[[], None]

_REST, _LEAST_REST = 0.05, 1e-4
"""Of ``fade_speed``, and at least so many m/s, which an encoder that toggles at rest does not show: below it the stage
counts as standing, and a pass ends."""
_STAGE_BANDWIDTH = 30.0
"""Hz, of the estimate of ẋ and ẍ."""
_SETTLED = 100
"""Samples after a restart until the estimated speed shows that the stage is at rest."""
_SHORTEST, _LONGEST = 200, 1_000_000
"""Samples of a pass that is learned from; a longer one is dropped."""
_JUMP = 0.01
"""m from where its speed takes a stage within a sample, more than any stage is."""
_ORDER = 2
"""Of the low-pass, which runs forward and backward."""


@dataclass(frozen=True)
class LearningParameters:
    """Learning from stroke to stroke."""

    learn: bool = parameter(False, "Learn from stroke to stroke, and correct the law's reference by what was learned")
    file: str = parameter(
        "",
        "File of the learned correction: read at the start if it exists, written when the controller is deactivated "
        "and when it ends; empty: memory only",
    )
    gain: float = parameter(0.3, "Fraction of a pass's error that is learned, once many were averaged", "(0, 1]")
    forgetting: float = parameter(0.01, "Fraction of the correction that each pass forgets", "[0, 0.5]")
    cutoff: float = parameter(
        35.0, "Errors up to this frequency are learned; below the servo's bandwidth", "(0, 1000] Hz"
    )
    limit: float = parameter(2e-6, "Largest correction of the reference", "(0, 0.0001] m")
    spacing: float = parameter(0.25e-3, "Distance of the nodes along x", "[1e-5, 0.01] m")
    fade_speed: float = parameter(
        0.02,
        "Speed of the stage below which the correction fades; slower than a twentieth of it, or than 0.1 mm/s, nothing "
        "is learned",
        "(0, 1] m/s",
    )
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
        ParameterError: the file is refused, or the cut-off is too near to half of the ``rate`` in Hz.
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
            for table in self.tables.values():
                table.bound(parameters.limit)
        self._rest = max(_REST * parameters.fade_speed, _LEAST_REST)
        self._tracked, self._stamp_ns = restarted(0.0), 0
        self._forward = True
        self.cut = False
        self.interrupt()

    def interrupt(self) -> None:
        """Drop the present pass, and correct nothing until the stage has stood still."""
        self._pass = array("d")
        self._samples, self._stood, self._spoiled = 0, False, False

    def spoil(self) -> None:
        """Learn nothing from the present pass, which a test signal disturbs."""
        self._spoiled = True

    def step(self, stamp_ns: int, x: float, y: float, reference: Reference) -> Reference:
        """The law's reference (m, m/s, m/s²) for a sample: stamp, x and y in m, and the reference asked for."""
        last, dt = self._tracked, (stamp_ns - self._stamp_ns) * 1e-9
        if not (self._samples and abs(x - last.x - dt * last.v) < _JUMP):
            self.interrupt()
            if math.isfinite(x):
                self._tracked = restarted(x)
                self._stamp_ns, self._samples = stamp_ns, 1
            return reference
        self._tracked = tracked = updated(_STAGE_BANDWIDTH, last, dt, x)
        self._stamp_ns = stamp_ns
        self._samples += 1
        self._spoiled = self._spoiled or self.cut
        v = tracked.v
        forward = v > 0.0
        if -self._rest < v < self._rest or forward is not self._forward:
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

    def check_file(self) -> None:
        """Raise ParameterError if :meth:`save` could not write the file now; call it before there is much to lose."""
        if self._parameters.file:
            try:
                check_writable(self._parameters.file)
            except OSError as error:
                allowed = "a file in a folder where this user may make files"
                raise ParameterError(f"{self._refusal(error)}; allowed: {allowed}") from error

    def save(self) -> None:
        """Write the file that the parameters name, if they do. If it cannot be written, OSError with a sentence; what
        was learned is still here then, and can be saved again."""
        if self._parameters.file:
            try:
                write_tables(Path(self._parameters.file), self._law, self.tables)
            except OSError as error:
                raise OSError(f"{self._refusal(error)}; what was learned is not saved") from error

    def _refusal(self, error: OSError) -> str:
        return f"parameter 'learning.file': {self._parameters.file!r} cannot be written: {error.strerror}"

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
