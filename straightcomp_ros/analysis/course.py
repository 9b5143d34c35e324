"""What a verdict is made from: the motion of a run, its error as far as it is known, and what disturbed it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.host_stalls import Stall
from straightcomp_ros.analysis.metrics import residual_over, true_error
from straightcomp_ros.analysis.record import Motion, ReferenceMap, StrokeRecord, find_motion
from straightcomp_ros.straightness.residual import peak_to_peak

RECOVERY = 0.1
"""Time in s after a disturbance in which its error decays: some ten periods of the slowest usual loop's bandwidth."""
RECOVERY_SAMPLES = 200
"""The same in samples, for a loop that samples slowly: its bandwidth is lower too."""
_COUNTED = 1e-12
"""Difference of two readings in m below which they are the same count, but for rounding."""


class GuideFit(NamedTuple):
    """How the guide's true deviation fits the map, beside the least squares line, in m: p-p and RMS of the guide, and
    of what a platform that follows the map exactly would leave."""

    guide_pp: float
    guide_rms: float
    left_pp: float
    left_rms: float


@dataclass(frozen=True, eq=False)
class Course:
    """The motion of a run, from its first to its last sample, pauses included; arrays (n,), in s, m and A.

    Attributes:
        time, x, y, r, current: of each sample; y is the true one if that is known.
        error: r − y, both true if they are known.
        true: whether they are.
        count: one count of the encoder of y in m.
        fit: of guide and map; None where nothing knows the guide.
        stalls: of the host within the motion.
    """

    time: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    r: NDArray[np.float64]
    current: NDArray[np.float64]
    error: NDArray[np.float64]
    true: bool
    count: float
    fit: GuideFit | None = None
    stalls: Sequence[Stall] = field(default=())

    @property
    def period(self) -> float:
        """Sampling period in s."""
        return float(np.median(np.diff(self.time)))

    @property
    def recovery(self) -> int:
        """Samples in which the error of a disturbance decays."""
        return max(round(RECOVERY / self.period), RECOVERY_SAMPLES)

    @property
    def pp(self) -> float:
        """Error in m, peak to peak."""
        return peak_to_peak(self.error)

    @property
    def uncompensated(self) -> float:
        """What a platform that stands still would leave: p-p of the reference, or of the guide if that is more."""
        return max(peak_to_peak(self.r), self.fit.guide_pp if self.fit else 0.0)


def course_of(record: StrokeRecord, reference: ReferenceMap, stalls: Sequence[Stall] = ()) -> Course:
    """The motion in ``record``, its reference made from ``reference``; MetricsError if the stage does not move."""
    motion = find_motion(record)
    window = motion.window
    truth = true_error(record, reference)
    error, y = (record.r - record.y, record.y) if truth is None or record.true_y is None else (truth, record.true_y)
    first, last = float(record.time[window.start]), float(record.time[window.stop - 1])
    return Course(
        time=record.time[window],
        x=record.x[window],
        y=y[window],
        r=record.r[window],
        current=record.current[window],
        error=error[window],
        true=truth is not None,
        count=encoder_count(record.y[window]),
        fit=_guide_fit(record, reference, motion),
        stalls=tuple(stall for stall in stalls if stall.end >= first and stall.start <= last),
    )


def encoder_count(readings: NDArray[np.float64]) -> float:
    """The smallest step between two different readings (n,) in m; 0 if all are the same."""
    levels = np.unique(readings)
    steps = np.diff(levels)
    steps = steps[steps > _COUNTED]
    return float(steps.min()) if steps.size else 0.0


def disturbed(course: Course, times: Sequence[Stall]) -> NDArray[np.bool_]:
    """The samples (n,) of ``course`` in any of these times, or so soon after that its error has not decayed yet."""
    mask = np.zeros(course.time.size, dtype=bool)
    for start, end in times:
        begin, stop = np.searchsorted(course.time, (start, end))
        mask[begin : stop + course.recovery] = True
    return mask


def _guide_fit(record: StrokeRecord, reference: ReferenceMap, motion: Motion) -> GuideFit | None:
    if record.true_x is None or record.guide is None:
        return None
    followed = record.guide + reference.evaluate(record.true_x)[0]
    guide, left = (residual_over(record.true_x, values, record, motion) for values in (record.guide, followed))
    return GuideFit(peak_to_peak(guide), float(guide.std()), peak_to_peak(left), float(left.std()))
