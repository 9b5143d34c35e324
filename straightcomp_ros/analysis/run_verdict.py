"""The verdict on a run: in order, or the one reason that explains best why its figures say nothing about the machine.

The reasons are tried from the most specific to the most general, because one leads to another: a stalled host makes the
platform oscillate, an oscillation saturates the current, and each of them makes the run inaccurate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.error_detail import (
    irregular_oscillation,
    stretches,
    sustained_oscillation,
    tolerated_amplitude,
)
from straightcomp_ros.analysis.evaluation import FOR_EVER, BagEvaluation
from straightcomp_ros.analysis.interruption import Stall
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
from straightcomp_ros.analysis.metrics import residual_over, true_error
from straightcomp_ros.analysis.record import Motion, ReferenceMap, StrokeRecord, find_motion, runs_of
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak


class Bounds(NamedTuple):
    """Bounds of a run; infinite where they are unknown.

    Attributes:
        current: largest |i_c| in A that the law may command and the D/A converter can.
        stop: the platform's mechanical stop at ± this position, m.
        first, last: x in m from which and up to which the map has a reference that follows the guide or runs out.
    """

    current: float = math.inf
    stop: float = math.inf
    first: float = -math.inf
    last: float = math.inf

    def within(self, straightness: StraightnessMap, runout: float) -> Bounds:
        """These bounds, with those of x from a map that runs out over ``runout`` in m."""
        first, last = straightness.span
        return self._replace(first=first - runout, last=last + runout)


def bounds_of(parameters: Mapping[str, Mapping[str, Any]], straightness: StraightnessMap | None = None) -> Bounds:
    """Bounds from parameters of each node alone, by dotted name, as a bag has them.

    A node that is there has its defaults for what is not named; of one that is not, nothing is known. A board on CAN
    reports neither its stop nor its converter, unless it is the emulator.
    """
    bounds, shipped = Bounds(), StageParameters()
    if "controller" in parameters:
        limit = parameters["controller"].get("stage.actuator.current_limit", shipped.actuator.current_limit)
        bounds = Bounds(current=float(limit))
    driver = parameters.get("driver", {"hardware": "unknown"})
    if driver.get("hardware", "simulated") == "simulated" or driver.get("can.simulated_stage", False):
        stop = float(driver.get("stage.platform.stop", shipped.platform.stop))
        bounds = bounds._replace(stop=stop, current=min(bounds.current, recorded_drive(driver).largest_current))
    if straightness is None:
        return bounds
    runout = parameters.get("feedforward", {}).get("stage.guide.runout", shipped.guide.runout)
    return bounds.within(straightness, float(runout))


def recorded_drive(driver: Mapping[str, Any]) -> DriveParameters:
    """D/A converter and amplifier from the driver's parameters by dotted name; defaults for what they do not name."""
    given = {name: driver.get(f"stage.drive.{name}", value) for name, value in asdict(DriveParameters()).items()}
    return DriveParameters(int(given.pop("dac_bits")), *map(float, given.values()))


RECOVERY = 0.1
"""Time in s after a disturbance in which its error decays: some ten periods of the slowest usual loop's bandwidth."""
RECOVERY_SAMPLES = 200
"""The same in samples, for a loop that samples slowly: its bandwidth is lower too."""
_COUNTED = 1e-12
"""Difference of two readings in m below which they are the same count, but for rounding."""


class GuideFit(NamedTuple):
    """How the guide's true deviation fits the map, from the least squares line, in m: p-p and RMS of the guide, and of
    what a platform that follows the map exactly would leave."""

    guide_pp: float
    guide_rms: float
    left_pp: float
    left_rms: float


@dataclass(frozen=True, eq=False)
class JudgedMotion:
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


def judged_motion(record: StrokeRecord, reference: ReferenceMap, stalls: Sequence[Stall] = ()) -> JudgedMotion:
    """The motion in ``record``, its reference made from ``reference``; MetricsError if the stage does not move."""
    motion = find_motion(record)
    window = motion.window
    truth = true_error(record, reference)
    error, y = (record.r - record.y, record.y) if truth is None or record.true_y is None else (truth, record.true_y)
    first, last = float(record.time[window.start]), float(record.time[window.stop - 1])
    return JudgedMotion(
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


def disturbed(motion: JudgedMotion, times: Sequence[Stall]) -> NDArray[np.bool_]:
    """The samples (n,) of ``motion`` in any of these times, or so soon after that its error has not decayed yet."""
    mask = np.zeros(motion.time.size, dtype=bool)
    for start, end in times:
        begin, stop = np.searchsorted(motion.time, (start, end))
        mask[begin : stop + motion.recovery] = True
    return mask


def _guide_fit(record: StrokeRecord, reference: ReferenceMap, motion: Motion) -> GuideFit | None:
    if record.true_x is None or record.guide is None:
        return None
    followed = record.guide + reference.evaluate(record.true_x)[0]
    guide, left = (residual_over(record.true_x, values, record, motion) for values in (record.guide, followed))
    return GuideFit(peak_to_peak(guide), float(guide.std()), peak_to_peak(left), float(left.std()))


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
    """The verdict on ``record``, whose platform was to follow ``reference``, made from the map ``straightness`` if that
    is known. ``parameters`` as in :func:`bounds_of`, ``stalls`` on the record's clock. MetricsError if the stage does
    not move."""
    return verdict_of(judged_motion(record, reference, stalls), bounds_of(parameters, straightness))


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


def verdict_of(motion: JudgedMotion, bounds: Bounds) -> Verdict:
    """The verdict on the run ``motion`` of a machine with ``bounds``.

    The true position is used where the run has it, otherwise the encoder's. Whether guide and map fit can only be said
    where the guide is known.
    """
    tried = (_at_stop, _left_map, _saturated, _wrong_guide, _oscillates, _inaccurate)
    later = next((found for reason in tried if (found := reason(motion, bounds))), None)
    return _starved(motion, later) or later or _in_order(motion)


def _starved(motion: JudgedMotion, later: Verdict | None) -> Verdict | None:
    if not motion.stalls:
        return None
    mask = disturbed(motion, motion.stalls)
    longest = max(end - start for start, end in motion.stalls)
    stalls = f"stalls of the host ({len(motion.stalls)}, the longest {longest * 1e3:.1f} ms)"
    remedy = "straightcomp doctor says what delays this computer"
    if np.count_nonzero(~mask) < _UNDISTURBED * mask.size:
        share = f"{stalls} disturbed {mask.mean():.0%} of the motion; allowed: {1.0 - _UNDISTURBED:.0%}"
        usual = float(np.ptp(np.quantile(motion.error, (0.5 * _RARE, 1.0 - 0.5 * _RARE))))
        if later is None and motion.pp > _PEAK * usual and motion.pp - usual > motion.count:
            later = Verdict(INACCURATE, f"error {_um(motion.pp)} p-p, {_um(usual)} in {1.0 - _RARE:.0%} of the motion")
        return None if later is None else Verdict(STARVED, f"{share}; {remedy}; {later.reason}")
    calm = peak_to_peak(motion.error[~mask])
    # A loop that fails without a stall too has another reason.
    if not _harmed(motion, mask) or calm > _largest(motion):
        return None
    return Verdict(
        STARVED,
        f"{stalls} made an error of {_um(motion.pp)} p-p; otherwise it was {_um(calm)}, and {_HARM:g} times that is "
        f"allowed; {remedy}",
    )


def _at_stop(motion: JudgedMotion, bounds: Bounds) -> Verdict | None:
    farthest = float(np.abs(motion.y).max())
    # The encoder rounds, and samples only see where the platform was at their own moments.
    if farthest < bounds.stop - motion.count:
        return None
    return Verdict(
        AT_STOP,
        f"|y| reached {_um(farthest)}; allowed: inside the mechanical stop at {_um(bounds.stop)}; check where the "
        "platform starts, the current limit, and by straightcomp robustness whether the law is stable on this machine",
    )


def _left_map(motion: JudgedMotion, bounds: Bounds) -> Verdict | None:
    low, high = float(motion.x.min()), float(motion.x.max())
    if low >= bounds.first and high <= bounds.last:
        return None
    return Verdict(
        LEFT_MAP,
        f"the stage moved from {_mm(low)} to {_mm(high)}; allowed: {_mm(bounds.first)} to {_mm(bounds.last)}, the "
        "survey and its run-out; shorten the motion, or survey the whole guide",
    )


def _saturated(motion: JudgedMotion, bounds: Bounds) -> Verdict | None:
    limited = np.sign(motion.current) * (np.abs(motion.current) >= _AT_LIMIT * bounds.current)
    if not limited.any():
        return None
    span = min(motion.recovery, limited.size)
    lacking = np.abs(np.convolve(limited, np.full(span, 1.0 / span), mode="same")) > _ONE_SIDED
    share = float(lacking.mean())
    if share <= _LACKS and not (lacking.any() and _harmed(motion, _with_recovery(motion, lacking))):
        return None
    return Verdict(
        SATURATED,
        f"the current stayed at its limit of {bounds.current:.4g} A for {share:.1%} of the motion, error "
        f"{_um(motion.pp)} p-p; allowed: {_LACKS:.0%}, without effect on the error; raise "
        "stage.actuator.current_limit or the range of the D/A converter, or look for a load on the platform",
    )


def _wrong_guide(motion: JudgedMotion, bounds: Bounds) -> Verdict | None:
    fit = motion.fit
    if fit is None or _still(motion) or motion.pp > _ACCURATE * motion.uncompensated:
        return None
    if fit.left_rms <= _LEFT * fit.guide_rms or fit.left_pp <= max(
        2.0 * motion.count, _NOTICED * peak_to_peak(motion.r)
    ):
        return None
    return Verdict(
        WRONG_GUIDE,
        f"the platform followed the map within {_um(motion.pp)} p-p, but of the guide's {_um(fit.guide_pp)} the map "
        f"leaves {_um(fit.left_pp)}, RMS {fit.left_rms / fit.guide_rms:.0%}; allowed: {_LEFT:.0%}; use a survey of "
        "this guide, and check its sign, unit and zero of x",
    )


def _oscillates(motion: JudgedMotion, bounds: Bounds) -> Verdict | None:
    pieces = list(stretches(motion.time, motion.error, motion.r))
    allowed = tolerated_amplitude(motion.error, motion.count, motion.uncompensated)
    found = max(sustained_oscillation(error, reference, motion.period) for error, reference in pieces)
    if found.amplitude <= allowed and motion.pp > _largest(motion):
        found = max(irregular_oscillation(error, reference, motion.period) for error, reference in pieces)
    if found.amplitude <= allowed:
        return None
    return Verdict(
        OSCILLATES,
        f"the loop oscillates at {found.frequency:.0f} Hz with an amplitude of {_um(found.amplitude)}, error "
        f"{_um(motion.pp)} p-p; allowed: {_um(allowed)}; compare mass, magnets, rate and delay of the machine with its "
        "description; straightcomp design finds gains that fit a description",
    )


def _inaccurate(motion: JudgedMotion, bounds: Bounds) -> Verdict | None:
    allowed = _largest(motion)
    if motion.pp <= allowed:
        return None
    return Verdict(
        INACCURATE,
        f"the error is {_um(motion.pp)} p-p where a platform that stands still would leave "
        f"{_um(motion.uncompensated)}; allowed: {_um(allowed)}; compare the machine with its description, and "
        "look for a fault or a load",
    )


def _largest(motion: JudgedMotion) -> float:
    """Largest error in m, p-p, of a run that is in order; infinite for one that is uncompensated."""
    if _still(motion):
        return math.inf
    few = _FEW_COUNTS * motion.count
    return min(max(_ACCURATE * motion.uncompensated, few), max(motion.uncompensated, motion.count))


def _in_order(motion: JudgedMotion) -> Verdict:
    if _still(motion):
        travel = _um(peak_to_peak(motion.r))
        return Verdict(IN_ORDER, f"uncompensated, the reference moved by {travel} only; error {_um(motion.pp)} p-p")
    mask = disturbed(motion, motion.stalls)
    calm = motion.pp if mask.all() else peak_to_peak(motion.error[~mask])
    raised = f", {_um(calm)} without the stalls of the host ({len(motion.stalls)})" if calm < motion.pp else ""
    return Verdict(
        IN_ORDER,
        f"error {_um(motion.pp)} p-p{raised}; a platform that stands still would leave {_um(motion.uncompensated)}",
    )


def _still(motion: JudgedMotion) -> bool:
    guide = motion.fit.guide_pp if motion.fit else 0.0
    return peak_to_peak(motion.r) <= max(_STILL, motion.count, _STILL_SHARE * guide)


def _harmed(motion: JudgedMotion, mask: NDArray[np.bool_]) -> bool:
    """Whether the error p-p was made in the samples ``mask`` (n,), and was `_HARM` times less, and more than a count
    less, in the others, as far as there are some."""
    if mask.all():
        return False
    calm = peak_to_peak(motion.error[~mask])
    return motion.pp > _HARM * calm and motion.pp - calm > motion.count


def _with_recovery(motion: JudgedMotion, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    times = [Stall(float(motion.time[a]), float(motion.time[b - 1])) for a, b in runs_of(mask).tolist()]
    return disturbed(motion, times)


def _um(length: float) -> str:
    return f"{length * 1e6:.3g} µm" if abs(length) < 1e-3 else f"{length * 1e3:.3g} mm"


def _mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
