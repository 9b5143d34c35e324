"""The figures of a run, of its strokes and of what follows each: compensation error, residual straightness, control
current, settling, standstill, reversal, friction."""

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import Array, ReferenceMap, StrokeRecord
from straightcomp_ros.straightness.residual import (
    end_point_residual,
    least_squares_residual,
    minimum_zone,
    peak_to_peak,
    rms,
)
from straightcomp_ros.straightness.survey_header import Direction

_UNITS = {
    **dict.fromkeys(("control_activity", "control_rms_step", "resting_rms_step"), ("_A", 1.0)),
    **dict.fromkeys(("duration", "settling", "start"), ("_s", 1.0)),
    **dict.fromkeys(("direction", "samples"), ("", 1.0)),
    "travel": ("_mm", 1e3),
}
"""How a figure is displayed: suffix of its name, and factor. All others are lengths, in µm."""
LINES = ("least_squares", "end_points", "minimum_zone")
"""Reference lines of a straightness, ISO 230-1:2012, 3.4."""
RESTING = 0.2
"""Time in s after a stroke, from which the command at rest is judged."""
SETTLED = 0.1e-6
"""Band in m, either way, within which the error counts as settled: a count of the shipped encoder."""
_REVERSAL = 0.1
"""Time in s before and after a reversal in which its error is made: ten periods of a loop's bandwidth of 100 Hz."""


@dataclass(frozen=True)
class Figures:
    """Figures of a run, in SI."""

    def to_display(self) -> dict[str, Any]:
        """The figures as a person reads them: lengths in µm, the travel in mm, the unit in each name."""
        shown = {}
        for name, value in asdict(self).items():
            suffix, factor = _UNITS.get(name, ("_um", 1e6))
            shown[name + suffix] = value * factor if isinstance(value, float) else value
        return shown


@dataclass(frozen=True)
class Metrics(Figures):
    """Figures of one run; lengths in m, currents in A, None where the record holds no truth.

    The compensation error is taken from the first to the last sample of motion, with the pauses between the strokes;
    ``_forward`` and ``_backward`` over the strokes of that direction only, None if there is none. RMS is about zero, so
    that a constant error counts. The residual straightness is taken over all samples in motion of both directions; the
    least squares line against x is removed (ISO 230-1), each piece of the guide counted by its length.
    """

    encoder_pp: float  # of the error r − y, y as the encoder sees it
    encoder_rms: float
    encoder_pp_forward: float | None
    encoder_pp_backward: float | None
    true_pp: float | None  # of the error r(true x) − true y
    true_rms: float | None
    true_pp_forward: float | None
    true_pp_backward: float | None
    residual_pp: float  # guide + true y over true x if the truth is there, otherwise as residual_encoder_pp
    residual_encoder_pp: float  # the map's δ(x) + y, both as the encoders see them: blind to the map's own error
    uncompensated_pp: float  # residual straightness if y were zero: of the guide, or of the map without truth
    control_activity: float  # Σ |Δ i_c| over the window
    control_rms_step: float  # root mean square of Δ i_c from sample to sample
    resting_rms_step: float | None  # the same between the strokes, from `RESTING` after each on; None without
    samples: int  # in the window
    duration: float  # of the window, s


@dataclass(frozen=True)
class StrokeFigures(Figures):
    """Figures of one movement one way; s, m. ``travel`` is that in x; the straightness by ISO 230-1 is relative to
    each line, from true positions where they are known, else the map's and the encoder's."""

    direction: str
    start: float
    duration: float
    travel: float
    encoder_pp: float  # compensation error as the encoder sees it
    encoder_rms: float
    true_pp: float | None  # the true one
    true_rms: float | None
    before_least_squares: float  # of the guide
    before_end_points: float
    after_least_squares: float  # of the workpiece
    after_end_points: float
    before_minimum_zone: float
    after_minimum_zone: float


def evaluate(record: StrokeRecord, straightness: ReferenceMap, map_of_guide: ReferenceMap | None = None) -> Metrics:
    """The figures of ``record``, with the map that its reference was made from, and ``map_of_guide`` where that is
    another one: the reference may have been centred.

    MetricsError if the stage does not move, or a number within the window is not finite.
    """
    motion, window = record.motion, record.motion.window
    record.check_finite(record.columns(), window)
    both = record.r - record.y, record.true_error(straightness)
    errors = _errors(*both, window)
    for way in ("forward", "backward"):
        samples = motion.samples(way)
        of_way = _errors(*both, samples) if samples.size else {}
        errors |= {f"{name}_{way}": of_way.get(name) for name in ("encoder_pp", "true_pp")}
    steps = np.diff(record.current[window])
    resting, stamps = [], np.round(record.time * 1e9)
    for one, following in itertools.pairwise(motion.strokes):
        # In whole nanoseconds: a sum of floats differs from a sample's time in its last bit.
        begin = np.searchsorted(stamps, stamps[one.stop - 1] + round(RESTING * 1e9))
        resting += np.diff(record.current[begin : following.start]).tolist()
    _, before, after = straightness_over(record, map_of_guide or straightness)
    of_encoder = record.guide_by(map_of_guide or straightness) + record.y
    return Metrics(
        **errors,
        residual_pp=peak_to_peak(after),
        residual_encoder_pp=peak_to_peak(residual_over(record.x, of_encoder, record)),
        uncompensated_pp=peak_to_peak(before),
        control_activity=float(np.abs(steps).sum()),
        control_rms_step=rms(steps),
        resting_rms_step=rms(np.array(resting)) if resting else None,
        samples=window.stop - window.start,
        duration=float(record.time[window.stop - 1] - record.time[window.start]),
    )


def stroke_figures(
    stroke: StrokeRecord, reference: ReferenceMap, direction: Direction, map_of_guide: ReferenceMap | None = None
) -> StrokeFigures:
    """Figures of a record of one ``stroke``; maps as of :func:`evaluate`."""
    time, (x, y, guide) = stroke.time, stroke.best_known(map_of_guide or reference)
    lines = {
        f"{name}_{line}": value
        for name, deviation in (("before", guide), ("after", guide + y))
        for line, value in about_lines(x, deviation, np.abs(np.gradient(x, time))).items()
    }
    return StrokeFigures(
        direction=direction,
        start=float(time[0]),
        duration=float(time[-1] - time[0]),
        travel=float(np.ptp(x)),
        **_errors(stroke.r - stroke.y, stroke.true_error(reference), slice(None)),
        **lines,
    )


@dataclass(frozen=True)
class StandstillFigures(Figures):
    """What follows one movement until the next one or the end of the record, in s and m; None where that is not shown.
    The error is the one by which the stroke is judged: the true one where it is known, else the encoder's.

    ``settling`` is the time from the last sample of motion until the error stays within the band up to the next motion:
    0 if it does at once, NaN if it never does. The standstill is what follows that, or the whole rest if it never
    settles. The reversal is the last time before and the first after a change of direction, pauses left out.
    """

    settling: float | None = None
    standstill_pp: float | None = None
    standstill_rms: float | None = None
    reversal_pp: float | None = None


def standstill_figures(record: StrokeRecord, reference: ReferenceMap) -> list[StandstillFigures]:
    """Figures of what follows each of the record's movements, in their order."""
    truth, strokes = record.true_error(reference), record.motion.strokes
    error = record.r - record.y if truth is None else truth
    period = float(np.median(np.diff(record.time)))
    around, found = max(1, round(_REVERSAL / period)), []
    for stroke, following in itertools.zip_longest(strokes, strokes[1:]):
        rest = error[stroke.stop : following.start if following else None]
        reversal = None
        if following and following.direction != stroke.direction:
            reversal = peak_to_peak([*error[stroke.samples][-around:], *error[following.samples][:around]])
        if not (rest.size and np.isfinite(rest).all()):
            found.append(StandstillFigures(reversal_pp=reversal))
            continue
        outside = np.flatnonzero(np.abs(rest) > SETTLED)
        settled = int(outside[-1]) + 1 if outside.size else 0
        lasts = settled < rest.size
        standing = rest[settled:] if lasts else rest
        # Samples may be missing.
        taken = float(record.time[stroke.stop + settled - 1] - record.time[stroke.stop - 1]) / period
        settling = round(taken) * period if lasts else math.nan
        found.append(StandstillFigures(settling, peak_to_peak(standing), rms(standing), reversal))
    return found


def _errors(encoder: Array, truth: Array | None, samples: slice | NDArray[np.intp]) -> dict[str, Any]:
    """p-p and RMS over ``samples`` of the error as the encoder sees it and of the true one, None without truth."""
    found: dict[str, Any] = {"true_pp": None, "true_rms": None}
    for name, error in (("encoder", encoder), ("true", truth)):
        if error is not None:
            found |= {f"{name}_pp": peak_to_peak(error[samples]), f"{name}_rms": rms(error[samples])}
    return found


def about_lines(x: Array, deviation: Array, weights: Array) -> dict[str, float]:
    """The straightness of ``deviation`` (n,) over ``x`` (n,) about each of :data:`LINES`, by its name, all in m;
    ``weights`` (n,) as for :func:`~straightcomp_ros.straightness.residual.least_squares_residual`."""
    residuals = least_squares_residual(x, deviation, weights), end_point_residual(x, deviation)
    return dict(zip(LINES, (*map(peak_to_peak, residuals), minimum_zone(x, deviation)), strict=True))


def residual_of_stroke(time: Array, x: Array, deviation: Array) -> Array:
    """``deviation`` (n,) over ``x`` (n,) in m of one movement, from its least squares line, weighed by the speed as in
    :func:`residual_over`."""
    return least_squares_residual(x, deviation, np.abs(np.gradient(x, time)))


def straightness_over(record: StrokeRecord, reference: ReferenceMap) -> tuple[Array, Array, Array]:
    """x of the samples in motion, and the straightness there before and after compensation, (m,) each in m: true where
    the truth is known, from the least squares lines."""
    x, y, guide = record.best_known(reference)
    before, after = (residual_over(x, values, record) for values in (guide, guide + y))
    return x[record.motion.samples()], before, after


def residual_over(x: Array, deviation: Array, record: StrokeRecord) -> Array:
    """``deviation`` (n,) over ``x`` (n,) in m, from its least squares line, (m,) for the samples in motion.

    Samples are weighed by the speed, since the stage lingers where it starts and stops.
    """
    moving = record.motion.samples()
    speed = np.abs(np.gradient(x, record.time))
    return least_squares_residual(x[moving], deviation[moving], speed[moving])


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


def force_balance(time: Array, y: Array, coil_current: Array) -> ForceBalance:
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
