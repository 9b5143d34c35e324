"""The verdict on a run: in order, or the one reason that explains best why its figures say nothing about the machine.

The reasons are tried from the most specific to the most general, because one leads to another: a stalled host makes the
platform oscillate, an oscillation saturates the current, and each of them makes the run inaccurate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.bounds import Bounds, bounds_of
from straightcomp_ros.analysis.course import Course, course_of, disturbed
from straightcomp_ros.analysis.error_detail import stretches
from straightcomp_ros.analysis.evaluation import FOR_EVER, BagEvaluation
from straightcomp_ros.analysis.host_stalls import Stall
from straightcomp_ros.analysis.judgement import (
    AT_STOP,
    CLOCK_JUMPED,
    IN_ORDER,
    INACCURATE,
    INTERRUPTED,
    LEFT_MAP,
    OSCILLATES,
    SATURATED,
    STARVED,
    WRONG_GUIDE,
    Verdict,
)
from straightcomp_ros.analysis.oscillation import irregular_oscillation, sustained_oscillation, tolerated_amplitude
from straightcomp_ros.analysis.record import ReferenceMap, StrokeRecord
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak

_HARM = 2.0
"""A disturbance did harm if the error is larger by this factor, p-p, than without the samples that it disturbed."""
_UNDISTURBED = 0.2
"""Fraction of a run that must be undisturbed so that its error can be compared with the rest's."""
_RARE, _PEAK = 0.01, 3.0
"""Of a run without such a rest: single stalls did harm if the error p-p is larger by this factor than without the
samples of its rarest values. In runs without stalls the factor is 1.2 to 2.2."""
_AT_LIMIT = 1.0 - 1e-9
"""Fraction of the largest current from which a command counts as limited."""
_ONE_SIDED = 0.5
"""Mean of the limited commands' signs over a recovery time from which the law lacks force: an oscillation that reaches
both limits in turn has about 0."""
_LACKS = 0.05
"""Fraction of the motion in which a law may lack force, if the error is not made there."""
_LEFT = 0.7
"""RMS of what the map leaves of the guide, relative to the guide: above, the map explains less than half of its
square."""
_NOTICED = 0.05
"""Fraction of the reference's travel below which what a map leaves says nothing: the survey's own noise on a short
stroke, where the guide hardly deviates from a line."""
_ACCURATE = 0.5
"""Largest error relative to the uncompensated deviation, both p-p."""
_FEW_COUNTS = 3.0
"""Counts of the encoder, p-p, which the best law leaves: no less is asked for on a nearly straight guide."""
_STILL = 0.1e-6
"""Travel in m of a reference that asks for nothing: the run is uncompensated. Twenty times less than the best guide."""
_STILL_SHARE = 0.01
"""The same relative to the true guide's deviation."""


def judged_run(
    record: StrokeRecord,
    reference: ReferenceMap,
    parameters: Mapping[str, Mapping[str, Any]],
    straightness: StraightnessMap | None = None,
    stalls: Sequence[Stall] = (),
) -> Verdict:
    """The verdict on ``record``.

    Args:
        record: the run.
        reference: what its platform was to follow.
        parameters: by node and dotted name, see :func:`straightcomp_ros.analysis.bounds.bounds_of`.
        straightness: the map behind the reference; None if it is unknown.
        stalls: of the host, on the record's clock.

    Raises:
        MetricsError: the stage does not move.
    """
    return verdict_of(course_of(record, reference, stalls), bounds_of(parameters, straightness))


def judged_bag(
    evaluation: BagEvaluation,
    record: StrokeRecord,
    reference: ReferenceMap,
    parameters: Mapping[str, Mapping[str, Any]],
    straightness: StraightnessMap | None = None,
) -> Verdict:
    """The verdict on a recorded run: :func:`judged_run` of its ``record``, if the law ran for the whole motion.

    MetricsError if the stage does not move while the law runs.
    """
    return partial_run(evaluation) or judged_run(record, reference, parameters, straightness, evaluation.stalls)


def partial_run(evaluation: BagEvaluation, begin_ns: int = 0, until_ns: int = FOR_EVER) -> Verdict | None:
    """The verdict on a run whose figures are those of a part of its motion; None for a whole one. With times, of its
    motion from ``begin_ns`` to before ``until_ns``."""
    if evaluation.clock_jump:
        return Verdict(
            CLOCK_JUMPED,
            f"{evaluation.clock_jump}; record again, with a driver whose stamps come from a monotonic clock",
        )
    reason = evaluation.interruption(begin_ns, until_ns)
    return Verdict(INTERRUPTED, f"{reason}; the figures are those of the motion before") if reason else None


def verdict_of(course: Course, bounds: Bounds) -> Verdict:
    """The verdict on the run ``course`` of a machine with ``bounds``.

    The true position is used where the run has it, otherwise the encoder's. Whether guide and map fit can only be said
    where the guide is known.
    """
    later = _first_reason(course, bounds)
    return _starved(course, later) or later or _in_order(course)


def _first_reason(course: Course, bounds: Bounds) -> Verdict | None:
    for tried in (_at_stop, _left_map, _saturated, _wrong_guide, _oscillates, _inaccurate):
        found = tried(course, bounds)
        if found is not None:
            return found
    return None


def _starved(course: Course, later: Verdict | None) -> Verdict | None:
    if not course.stalls:
        return None
    mask = disturbed(course, course.stalls)
    longest = max(end - start for start, end in course.stalls)
    stalls = f"stalls of the host ({len(course.stalls)}, the longest {longest * 1e3:.1f} ms)"
    remedy = "straightcomp doctor says what delays this computer"
    if np.count_nonzero(~mask) < _UNDISTURBED * mask.size:
        share = f"{stalls} disturbed {mask.mean():.0%} of the motion; allowed: {1.0 - _UNDISTURBED:.0%}"
        usual = float(np.ptp(np.quantile(course.error, (0.5 * _RARE, 1.0 - 0.5 * _RARE))))
        if later is None and course.pp > _PEAK * usual and course.pp - usual > course.count:
            later = Verdict(INACCURATE, f"error {_um(course.pp)} p-p, {_um(usual)} in {1.0 - _RARE:.0%} of the motion")
        return None if later is None else Verdict(STARVED, f"{share}; {remedy}; {later.reason}")
    calm = peak_to_peak(course.error[~mask])
    # A loop that fails without a stall too has another reason.
    if not _harmed(course, mask) or calm > _largest(course):
        return None
    return Verdict(
        STARVED,
        f"{stalls} made an error of {_um(course.pp)} p-p; otherwise it was {_um(calm)}, and {_HARM:g} times that is "
        f"allowed; {remedy}",
    )


def _at_stop(course: Course, bounds: Bounds) -> Verdict | None:
    farthest = float(np.abs(course.y).max())
    # The encoder rounds, and samples only see where the platform was at their own moments.
    if farthest < bounds.stop - course.count:
        return None
    return Verdict(
        AT_STOP,
        f"|y| reached {_um(farthest)}; allowed: inside the mechanical stop at {_um(bounds.stop)}; check where the "
        "platform starts, the current limit, and by straightcomp robustness whether the law is stable on this machine",
    )


def _left_map(course: Course, bounds: Bounds) -> Verdict | None:
    low, high = float(course.x.min()), float(course.x.max())
    if low >= bounds.first and high <= bounds.last:
        return None
    return Verdict(
        LEFT_MAP,
        f"the stage moved from {_mm(low)} to {_mm(high)}; allowed: {_mm(bounds.first)} to {_mm(bounds.last)}, the "
        "survey and its run-out; shorten the motion, or survey the whole guide",
    )


def _saturated(course: Course, bounds: Bounds) -> Verdict | None:
    limited = np.sign(course.current) * (np.abs(course.current) >= _AT_LIMIT * bounds.current)
    if not limited.any():
        return None
    span = min(course.recovery, limited.size)
    lacking = np.abs(np.convolve(limited, np.full(span, 1.0 / span), mode="same")) > _ONE_SIDED
    share = float(lacking.mean())
    if share <= _LACKS and not (lacking.any() and _harmed(course, _with_recovery(course, lacking))):
        return None
    return Verdict(
        SATURATED,
        f"the current stayed at its limit of {bounds.current:.4g} A for {share:.1%} of the motion, error "
        f"{_um(course.pp)} p-p; allowed: {_LACKS:.0%}, without effect on the error; raise "
        "stage.actuator.current_limit or the range of the D/A converter, or look for a load on the platform",
    )


def _wrong_guide(course: Course, bounds: Bounds) -> Verdict | None:
    fit = course.fit
    if fit is None or _still(course) or course.pp > _ACCURATE * course.uncompensated:
        return None
    if fit.left_rms <= _LEFT * fit.guide_rms or fit.left_pp <= max(
        2.0 * course.count, _NOTICED * peak_to_peak(course.r)
    ):
        return None
    return Verdict(
        WRONG_GUIDE,
        f"the platform followed the map within {_um(course.pp)} p-p, but of the guide's {_um(fit.guide_pp)} the map "
        f"leaves {_um(fit.left_pp)}, RMS {fit.left_rms / fit.guide_rms:.0%}; allowed: {_LEFT:.0%}; use a survey of "
        "this guide, and check its sign, unit and zero of x",
    )


def _oscillates(course: Course, bounds: Bounds) -> Verdict | None:
    pieces = list(stretches(course.time, course.error, course.r))
    allowed = tolerated_amplitude(course.error, course.count, course.uncompensated)
    found = max(sustained_oscillation(error, reference, course.period) for error, reference in pieces)
    if found.amplitude <= allowed and course.pp > _largest(course):
        found = max(irregular_oscillation(error, reference, course.period) for error, reference in pieces)
    if found.amplitude <= allowed:
        return None
    return Verdict(
        OSCILLATES,
        f"the loop oscillates at {found.frequency:.0f} Hz with an amplitude of {_um(found.amplitude)}, error "
        f"{_um(course.pp)} p-p; allowed: {_um(allowed)}; compare mass, magnets, rate and delay of the machine with its "
        "description; straightcomp design finds gains that fit a description",
    )


def _inaccurate(course: Course, bounds: Bounds) -> Verdict | None:
    allowed = _largest(course)
    if course.pp <= allowed:
        return None
    return Verdict(
        INACCURATE,
        f"the error is {_um(course.pp)} p-p where a platform that stands still would leave "
        f"{_um(course.uncompensated)}; allowed: {_um(allowed)}; compare the machine with its description, and "
        "look for a fault or a load",
    )


def _largest(course: Course) -> float:
    """Largest error in m, p-p, of a run that is in order; infinite for one that is uncompensated."""
    if _still(course):
        return math.inf
    few = _FEW_COUNTS * course.count
    return min(max(_ACCURATE * course.uncompensated, few), max(course.uncompensated, course.count))


def _in_order(course: Course) -> Verdict:
    if _still(course):
        travel = _um(peak_to_peak(course.r))
        return Verdict(IN_ORDER, f"uncompensated, the reference moved by {travel} only; error {_um(course.pp)} p-p")
    mask = disturbed(course, course.stalls)
    calm = course.pp if mask.all() else peak_to_peak(course.error[~mask])
    raised = f", {_um(calm)} beside the stalls of the host ({len(course.stalls)})" if calm < course.pp else ""
    return Verdict(
        IN_ORDER,
        f"error {_um(course.pp)} p-p{raised}; a platform that stands still would leave {_um(course.uncompensated)}",
    )


def _still(course: Course) -> bool:
    guide = course.fit.guide_pp if course.fit else 0.0
    return peak_to_peak(course.r) <= max(_STILL, course.count, _STILL_SHARE * guide)


def _harmed(course: Course, mask: NDArray[np.bool_]) -> bool:
    """Whether the error p-p was made in the samples ``mask`` (n,), and was `_HARM` times less, and more than a count
    less, in the others, as far as there are some."""
    if mask.all():
        return False
    calm = peak_to_peak(course.error[~mask])
    return course.pp > _HARM * calm and course.pp - calm > course.count


def _with_recovery(course: Course, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2).tolist()
    return disturbed(course, [Stall(float(course.time[a]), float(course.time[b - 1])) for a, b in edges])


def _um(length: float) -> str:
    return f"{length * 1e6:.3g} µm" if abs(length) < 1e-3 else f"{length * 1e3:.3g} mm"


def _mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
