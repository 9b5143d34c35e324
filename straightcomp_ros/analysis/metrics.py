"""The figures of a run and of its strokes: compensation error, residual straightness, control current, friction."""

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import (
    MetricsError,
    Motion,
    ReferenceMap,
    Stroke,
    StrokeRecord,
    check_finite,
    find_motion,
)
from straightcomp_ros.straightness.residual import end_point_residual, least_squares_residual, peak_to_peak

__all__ = ["Metrics", "MetricsError", "StrokeFigures", "evaluate", "residual_over", "stroke_figures", "true_error"]

_UNITS = {
    **dict.fromkeys(("control_activity", "control_rms_step", "resting_rms_step"), ("_A", 1.0)),
    **dict.fromkeys(("duration", "start"), ("_s", 1.0)),
    **dict.fromkeys(("direction", "samples"), ("", 1.0)),
    "travel": ("_mm", 1e3),
}
"""How a figure is displayed: suffix of its name, and factor. All others are lengths, in µm."""
RESTING = 0.2
"""Time in s after a stroke, from which the command at rest is judged."""


@dataclass(frozen=True)
class _Figures:
    def to_display(self) -> dict[str, Any]:
        """The figures as a person reads them: lengths in µm, the travel in mm, the unit in each name."""
        shown = {}
        for name, value in asdict(self).items():
            suffix, factor = _UNITS.get(name, ("_um", 1e6))
            shown[name + suffix] = value * factor if isinstance(value, float) else value
        return shown


@dataclass(frozen=True)
class Metrics(_Figures):
    """Figures of one run; lengths in m, currents in A, None where the record holds no truth.

    The compensation error is taken from the first to the last sample of motion, with the pauses between the strokes;
    ``_forward`` and ``_backward`` over the strokes of that direction only, None if there is none. RMS is about zero, so
    that a constant error counts. The residual straightness is taken over all samples in motion of both directions; the
    least squares line against x is removed (ISO 230-1), each piece of the guide counted by its length.

    Attributes:
        encoder_pp, encoder_rms, encoder_pp_forward, encoder_pp_backward: error r − y, y as the encoder sees it.
        true_pp, true_rms, true_pp_forward, true_pp_backward: error r(true x) − true y.
        residual_pp: guide + true y over true x if the truth is there, otherwise as ``residual_encoder_pp``.
        residual_encoder_pp: the map's δ(x) + y, both as the encoders see them: blind to the map's own error.
        uncompensated_pp: residual straightness if y were zero: of the guide, or of the map without truth.
        control_activity: Σ |Δ i_c| over the window, A.
        control_rms_step: root mean square of Δ i_c from sample to sample, A.
        resting_rms_step: the same in the pauses between the strokes, from `RESTING` after each stroke on; None without.
        samples: samples in the window.
        duration: of the window, s.
    """

    encoder_pp: float
    encoder_rms: float
    encoder_pp_forward: float | None
    encoder_pp_backward: float | None
    true_pp: float | None
    true_rms: float | None
    true_pp_forward: float | None
    true_pp_backward: float | None
    residual_pp: float
    residual_encoder_pp: float
    uncompensated_pp: float
    control_activity: float
    control_rms_step: float
    resting_rms_step: float | None
    samples: int
    duration: float


@dataclass(frozen=True)
class StrokeFigures(_Figures):
    """Figures of one movement one way; s, m.

    Attributes:
        start, duration, travel: of the movement, travel in x.
        encoder_pp, encoder_rms: compensation error as the encoder sees it.
        true_pp, true_rms: the true one, None without truth.
        before_least_squares, before_end_points: straightness of the guide by ISO 230-1, relative to either line.
        after_least_squares, after_end_points: straightness of the workpiece, likewise. True positions where they are
            known, else the map's and the encoder's.
    """

    direction: str
    start: float
    duration: float
    travel: float
    encoder_pp: float
    encoder_rms: float
    true_pp: float | None
    true_rms: float | None
    before_least_squares: float
    before_end_points: float
    after_least_squares: float
    after_end_points: float


def evaluate(record: StrokeRecord, straightness: ReferenceMap) -> Metrics:
    """The figures of ``record``, with the map that its reference was made from.

    MetricsError if the stage does not move, or a number within the window is not finite.
    """
    motion = find_motion(record)
    window = motion.window
    check_finite(record, tuple(record.columns()), window)

    def stroke_pp(error: NDArray[np.float64] | None, samples: NDArray[np.intp]) -> float | None:
        return peak_to_peak(error[samples]) if error is not None and samples.size else None

    forward, backward = motion.samples("forward"), motion.samples("backward")
    error = record.r - record.y
    truth = true_error(record, straightness)
    steps = np.diff(record.current[window])
    known = record.best_known(straightness)
    of_encoder = straightness.deviations(record.x) + record.y
    return Metrics(
        encoder_pp=peak_to_peak(error[window]),
        encoder_rms=_rms(error[window]),
        encoder_pp_forward=stroke_pp(error, forward),
        encoder_pp_backward=stroke_pp(error, backward),
        true_pp=None if truth is None else peak_to_peak(truth[window]),
        true_rms=None if truth is None else _rms(truth[window]),
        true_pp_forward=stroke_pp(truth, forward),
        true_pp_backward=stroke_pp(truth, backward),
        residual_pp=peak_to_peak(residual_over(known.x, known.guide + known.y, record, motion)),
        residual_encoder_pp=peak_to_peak(residual_over(record.x, of_encoder, record, motion)),
        uncompensated_pp=peak_to_peak(residual_over(known.x, known.guide, record, motion)),
        control_activity=float(np.abs(steps).sum()),
        control_rms_step=_rms(steps),
        resting_rms_step=_resting_rms_step(record, motion),
        samples=window.stop - window.start,
        duration=float(record.time[window.stop - 1] - record.time[window.start]),
    )


def stroke_figures(
    record: StrokeRecord, reference: ReferenceMap, truth: NDArray[np.float64] | None, stroke: Stroke
) -> StrokeFigures:
    """Figures of ``stroke`` in ``record``; ``truth`` is :func:`true_error` of the record."""
    part = stroke.samples
    error = (record.r - record.y)[part]
    known = record.best_known(reference)
    x, guide, after = known.x[part], known.guide[part], (known.guide + known.y)[part]
    of_truth = None if truth is None else truth[part]
    return StrokeFigures(
        direction=stroke.direction,
        start=float(record.time[stroke.start]),
        duration=float(record.time[stroke.stop - 1] - record.time[stroke.start]),
        travel=float(np.ptp(x)),
        encoder_pp=peak_to_peak(error),
        encoder_rms=_rms(error),
        true_pp=None if of_truth is None else peak_to_peak(of_truth),
        true_rms=None if of_truth is None else _rms(of_truth),
        before_least_squares=peak_to_peak(residual_of_stroke(record.time[part], x, guide)),
        before_end_points=peak_to_peak(end_point_residual(x, guide)),
        after_least_squares=peak_to_peak(residual_of_stroke(record.time[part], x, after)),
        after_end_points=peak_to_peak(end_point_residual(x, after)),
    )


def residual_of_stroke(
    time: NDArray[np.float64], x: NDArray[np.float64], deviation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``deviation`` (n,) over ``x`` (n,) in m of one movement, from its least squares line, weighed by the speed as in
    :func:`residual_over`."""
    return least_squares_residual(x, deviation, np.abs(np.gradient(x, time)))


def true_error(record: StrokeRecord, straightness: ReferenceMap) -> NDArray[np.float64] | None:
    """r(true x) − true y, (n,) in m; None without truth."""
    if record.true_x is None or record.true_y is None:
        return None
    return straightness.evaluate(record.true_x)[0] - record.true_y


def residual_over(
    x: NDArray[np.float64], deviation: NDArray[np.float64], record: StrokeRecord, motion: Motion
) -> NDArray[np.float64]:
    """``deviation`` (n,) over ``x`` (n,) in m, from its least squares line, (m,) for the samples ``motion.samples()``.

    Samples are weighed by the speed, since the stage lingers where it starts and stops.
    """
    moving = motion.samples()
    speed = np.abs(np.gradient(x, record.time))
    return least_squares_residual(x[moving], deviation[moving], speed[moving])


def _resting_rms_step(record: StrokeRecord, motion: Motion) -> float | None:
    steps = np.zeros(0)
    for before, after in itertools.pairwise(motion.strokes):
        begin = np.searchsorted(record.time, record.time[before.stop - 1] + RESTING)
        steps = np.append(steps, np.diff(record.current[begin : after.start]))
    return _rms(steps) if steps.size else None


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values * values)))


_SPAN = 0.05
"""Time in s over which ẏ is taken: longer than a count of the encoder takes."""
_SLIDING = 0.2
"""Fraction of the 90th percentile of |ẏ| from which the platform counts as sliding."""
_BENDING = 2e-6
"""Travel in m after a reversal in which the bristles bend: four times that of the shipped stage."""
_LEAST = 500
"""Samples of sliding in each direction."""
_LEAST_TRAVEL = 2.0 * _BENDING
"""Travel of the platform in m below which hardly any of it is sliding."""


class ForceBalance(NamedTuple):
    """Friction in A and K̄_y/K̄_i in A/m; NaN where they are not identifiable."""

    friction: float
    stiffness: float


def force_balance(time: NDArray[np.float64], y: NDArray[np.float64], coil_current: NDArray[np.float64]) -> ForceBalance:
    """The balance of a stroke; ``time`` in s, ``y`` in m and measured ``coil_current`` in A, (n,) each.

    Samples with NaN are left out. The values are NaN where the platform does not slide long enough both ways.
    """
    from scipy.ndimage import uniform_filter1d

    known = np.isfinite(y) & np.isfinite(coil_current)
    time, y, coil_current = time[known], y[known], coil_current[known]
    if time.size < 2 * _LEAST or np.ptp(y) < _LEAST_TRAVEL:
        return ForceBalance(math.nan, math.nan)
    width = max(3, round(_SPAN / float(np.median(np.diff(time)))))
    velocity = uniform_filter1d(np.gradient(uniform_filter1d(y, width, mode="nearest"), time), width, mode="nearest")
    turned = np.diff(np.sign(velocity), prepend=0.0) != 0.0
    turning_point = np.maximum.accumulate(np.where(turned, np.arange(y.size), 0))
    sliding = np.abs(velocity) > _SLIDING * float(np.percentile(np.abs(velocity), 90))
    sliding &= np.abs(y - y[turning_point]) > _BENDING
    way = np.sign(velocity[sliding])
    if min(np.count_nonzero(way > 0.0), np.count_nonzero(way < 0.0)) < _LEAST:
        return ForceBalance(math.nan, math.nan)
    terms = np.stack([np.ones(way.size), -y[sliding], way], axis=1)
    (_, stiffness, friction), *_ = np.linalg.lstsq(terms, coil_current[sliding], rcond=None)
    return ForceBalance(float(friction), float(stiffness))
