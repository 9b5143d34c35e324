"""The verdict on a run: in order, or the one reason that explains best why its figures say nothing about the machine.

The reasons are tried from the most specific to the most general, because one leads to another: a stalled host makes the
platform oscillate, an oscillation saturates the current, and each of them makes the run inaccurate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from straightcomp_ros.analysis import causes, error_detail
from straightcomp_ros.analysis import judgement as words
from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.analysis.judged_motion import (
    ACCURATE,
    FEW_COUNTS,
    HARM,
    GuideFit,
    JudgedMotion,
    Left,
    bounds_of,
    encoder_count,
    recorded_drive,
)
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import force_balance, residual_over
from straightcomp_ros.analysis.record import Array, ReferenceMap, StrokeRecord, group_means, runs_of
from straightcomp_ros.control.margins import AS_DESCRIBED
from straightcomp_ros.model.paced_motion import ARRIVED_M
from straightcomp_ros.parameters.node_parameters import Values, by_node
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import least_squares_residual, peak_to_peak

if TYPE_CHECKING:
    from straightcomp_ros.offline.promise import Promise

_UNDISTURBED = 0.2
"""Fraction of a run that must be undisturbed so that its error can be compared with the rest's."""
_RARE, _PEAK = 0.01, 3.0
"""Of a run without such a rest: single stalls did harm if the error p-p is larger by this factor than without the
samples of its rarest values. In runs without stalls the factor is 1.2 to 2.2."""
_ONE_SIDED = 0.5
"""Mean of the limited commands' signs over a recovery time from which the law lacks force: an oscillation that reaches
both limits in turn has about 0."""
_LACKS = 0.05
"""Fraction of the motion in which a law may lack force, if the error is not made there."""
_PIECES, _READINGS = 200, 5
"""Pieces of x over which the readings of a displacement sensor are averaged, and the least mean number in each."""
_OF_LOOP = 0.0125
"""Frequency relative to the rate from which an error without a held line is the loop's: slower ones it rejects, and
what then is left of a disturbance has no line either."""
_SEEN = 0.5
"""Part of an error's RMS in the encoder's readings below which the encoder made it: a quarter of its power."""
_UNSTABLE = "the law is unstable on the stage as it is described: straightcomp design finds gains for a stage"
_HUNTS = 0.02
"""Least motion at rest relative to the whole guide's deviation, both p-p, that is hunting."""


def judged_motion(
    record: StrokeRecord,
    reference: ReferenceMap,
    parameters: Mapping[str, Mapping[str, Any]],
    straightness: StraightnessMap | None = None,
    stalls: Sequence[Stall] = (),
    latency: Array | None = None,
    sensor: Array | None = None,
) -> JudgedMotion:
    """What is judged of ``record``, whose platform was to follow ``reference``, made from the map ``straightness`` if
    that is known. ``parameters`` as in :func:`bounds_of`, ``stalls`` on the record's clock, ``latency`` as of
    :func:`late_commands`, ``sensor`` the readings (n,) in m of the guide's deviation by a displacement sensor at the
    record's samples, up to a constant, NaN where it has none. MetricsError if the stage does not move, or a number
    within the motion is not finite."""

    def promise() -> Promise | None:
        # Only here: it loads what simulates a stroke, which most runs do not need.
        from straightcomp_ros.offline.promise import promise_of

        return promise_of(record, parameters, straightness)

    record.check_finite(record.columns(), record.motion.window)
    run = record.moving
    truth, seen, first, last = run.true_error(reference), run.r - run.y, run.time[0], run.time[-1]
    return JudgedMotion(
        time=run.time,
        x=run.x,
        y=run.y if run.true_y is None else run.true_y,
        r=run.r,
        current=run.current,
        error=seen if truth is None else truth,
        count=encoder_count(run.y),
        by_encoder=truth is None,
        unseen=truth is not None and float(seen.std()) < _SEEN * float(truth.std()),
        zero=0.0 if run.true_x is None else float(np.mean(run.true_x - run.x)),
        fit=_guide_fit(record, reference, straightness, sensor),
        stalls=tuple(stall for stall in stalls if stall.end >= first and stall.start <= last),
        promise=promise,
        **bounds_of(parameters, straightness),
        late="" if latency is None else late_commands(latency, parameters.get("driver", {})),
    )


def verdict_on(record: StrokeRecord, straightness: StraightnessMap, values: Values) -> Verdict:
    """The verdict on a simulated run of nodes with the parameters ``values``, whose reference was made from the map
    ``straightness``. MetricsError as of :func:`judged_motion`."""
    return verdict_of(judged_motion(record, straightness, by_node(values), straightness))


def late_commands(latency: Array, driver: Mapping[str, Any]) -> str:
    """That commands came later than the stage's description allows, with the remedy; empty if they did not.

    ``latency`` is the time in s from each sample until its command arrived, ``driver`` the driver's parameters by
    dotted name, with defaults for what they do not name. A command that arrives after ``stage.drive.delay`` acts on
    arrival. Gains are designed for delays up to ``stage.uncertainty.longest_delay`` times as long.
    """
    shipped, delay = StageParameters(), recorded_drive(driver).delay
    rate = float(driver.get("stage.rate", shipped.rate))
    longest = float(driver.get("stage.uncertainty.longest_delay", shipped.uncertainty.longest_delay))
    allowed = delay * max(1.0, longest)
    if not latency.size:
        return ""
    median, rare = np.quantile(latency, (0.5, 1.0 - _RARE)) * rate
    if rare <= allowed + 1e-9 * rate:
        return ""
    share = np.mean(latency * rate > allowed)
    return (
        f"commands came {median:.2g} samples after theirs, {rare:.2g} at p99, and acted on arrival: {share:.0%} of "
        f"them later than 'stage.drive.delay' {delay:g} and 'stage.uncertainty.longest_delay' allow: {allowed:.3g}; "
        "describe the delay that is measured, and design the gains for it, or make the loop faster (composed, "
        "realtime.priority)"
    )


def _guide_fit(
    record: StrokeRecord, reference: ReferenceMap, straightness: StraightnessMap | None, sensor: Array | None
) -> GuideFit | None:
    if record.true_x is not None and record.guide is not None:
        x, noise = record.true_x[record.motion.samples()], 0.0
        both = record.guide, record.guide + record.followed(reference)
        guide, left = (residual_over(record.true_x, values, record) for values in both)
    else:
        moving = record.motion.samples()
        known = moving[:0] if sensor is None else moving[np.isfinite(sensor[moving])]
        if sensor is None or known.size < _READINGS * _PIECES:
            return None
        # Means over pieces of x each way have little of the sensor's noise, and all have the same: the spread says how
        # much, of as many readings in each.
        x, readings = record.x[known], sensor[known]
        apart, back = readings + record.followed(reference)[known], np.isin(known, record.motion.samples("backward"))
        piece = np.empty(known.size, np.intp)
        for way in (False, True):
            ours = np.flatnonzero(back == way)
            piece[ours[np.argsort(x[ours])]] = np.arange(ours.size) * _PIECES // ours.size + _PIECES * way
        (middle, guide), followed = group_means(x, readings, piece), group_means(x, apart, piece)[1]
        spread = np.maximum(group_means(x, apart**2, piece)[1] - followed**2, 0.0)
        noise = float(np.sqrt(np.mean(spread) * guide.size / (known.size - guide.size)))
        # The stage lingers where it starts and stops, and one way may be slower: each piece counts by its length.
        speed = np.abs(np.gradient(record.x, record.time))[known]
        length = group_means(x, speed, piece)[1] * np.unique(piece, return_counts=True)[1]
        x, (guide, left) = middle, (least_squares_residual(middle, one, length) for one in (guide, followed))
    cause = causes.of_map(x, left, reference.deviations, straightness)
    return GuideFit(peak_to_peak(guide), peak_to_peak(left), cause, noise)


def verdict_of(motion: JudgedMotion) -> Verdict:
    """The verdict on the run ``motion``. Whether guide and map fit can only be said where the guide is known."""
    later = next((Verdict(word, reason) for word, why in _REASONS if (reason := why(motion))), None)
    if later is None and not (later := _disturbed(motion)) and (reason := _inaccurate(motion)):
        later = Verdict(words.INACCURATE, reason)
    if motion.stalls and (reason := _starved(motion, later)):
        return Verdict(words.STARVED, reason)
    word, reason = later or Verdict(words.IN_ORDER, _in_order(motion))
    return Verdict(word, f"{reason}; {motion.late}" if motion.late else reason)


def _starved(motion: JudgedMotion, later: Verdict | None) -> str:
    mask = motion.disturbed(motion.stalls)
    longest = max(end - start for start, end in motion.stalls)
    count = f"{len(motion.stalls)} times samples or commands were late or missing"
    stalls = f"stalls of the host ({count}, for at most {longest * 1e3:.1f} ms)"
    remedy = "end other programs, permit real-time priority (straightcomp doctor says how), and run it again"
    if np.count_nonzero(~mask) < _UNDISTURBED * mask.size:
        share = f"{stalls} disturbed {mask.mean():.0%} of the motion; allowed: {1.0 - _UNDISTURBED:.0%}"
        reason = later.reason if later else ""
        usual = float(np.ptp(np.quantile(motion.error, (0.5 * _RARE, 1.0 - 0.5 * _RARE))))
        if not reason and motion.pp > _PEAK * usual and motion.pp - usual > motion.count:
            reason = f"error {_um(motion.pp)} p-p, {_um(usual)} in {1.0 - _RARE:.0%} of the motion"
        return f"the computer was too busy to judge the servo: {share}; {remedy}; {reason}" if reason else ""
    # A loop that fails without a stall too has another reason.
    calm = motion.calm(mask)
    if not motion.harmed(mask) or calm > motion.largest:
        return ""
    made = f"the servo works, the computer was busy: error {_um(calm)} p-p, but {stalls} made it {_um(motion.pp)}"
    if not motion.judgeable(mask):
        made = (
            f"the computer was busy: {stalls} made the error {_um(motion.pp)} p-p, and less than half of the travel is "
            "left without them, too little to judge"
        )
    return f"{made}; allowed: {HARM:g} times; {remedy}"


def _at_stop(motion: JudgedMotion) -> str:
    farthest = float(np.abs(motion.y).max())
    # The encoder rounds, and samples only see where the platform was at their own moments.
    if farthest < motion.stop - motion.count:
        return ""
    remedy = (
        "check where the platform starts, the current limit, and by straightcomp robustness whether the law is stable "
        "on this machine; it may have a mode that nobody described (stage.platform.modes): straightcomp commission "
        "finds one"
    )
    if motion.unstable_where() == AS_DESCRIBED:
        remedy = _UNSTABLE
    return f"|y| reached {_um(farthest)}; allowed: inside the mechanical stop at {_um(motion.stop)}; {remedy}"


def _left_map(motion: JudgedMotion) -> str:
    low, high, (first, last) = float(motion.x.min()), float(motion.x.max()), motion.span
    if low >= first and high <= last:
        return ""
    return (
        f"the stage moved from {_mm(low)} to {_mm(high)}; allowed: {_mm(first)} to {_mm(last)}, the "
        "survey and its run-out; shorten the motion, or survey the whole guide"
    )


def _unstable(motion: JudgedMotion) -> str:
    """Before what else such a loop does; where modes make it unstable, :func:`_disturbed` says so."""
    if not motion.exceeds or motion.unstable_where() != AS_DESCRIBED or motion.destabilised():
        return ""
    return f"{_UNSTABLE}: error {_um(motion.pp)} p-p; allowed: {_um(motion.largest)}"


def _saturated(motion: JudgedMotion) -> str:
    limited = np.sign(motion.current) * motion.limited
    if not limited.any():
        return ""
    span = min(motion.recovery, limited.size)
    lacking = np.abs(np.convolve(limited, np.full(span, 1.0 / span), mode="same")) > _ONE_SIDED
    share = float(lacking.mean())
    times = [Stall(float(motion.time[a]), float(motion.time[b - 1])) for a, b in runs_of(lacking).tolist()]
    if share <= _LACKS and not motion.harmed(motion.disturbed(times)):
        return ""
    return (
        f"the current stayed at its limit of {motion.current_limit:.4g} A for {share:.1%} of the motion, error "
        f"{_um(motion.pp)} p-p; allowed: {_LACKS:.0%}, without effect on the error; raise "
        "stage.actuator.current_limit or the range of the D/A converter, or look for a load on the platform"
    )


def _wrong_guide(motion: JudgedMotion) -> str:
    fit = motion.fit
    if fit is None or motion.still or motion.pp > motion.largest or fit.left_pp <= motion.largest_of_map:
        return ""
    return (
        f"the platform followed the map within {_um(motion.pp)} p-p, but of the guide's {_um(fit.guide_pp)} the map "
        f"leaves {_um(fit.left_pp)}; allowed: {_um(motion.largest_of_map)}; {fit.cause}"
    )


def _line(motion: JudgedMotion) -> tuple[error_detail.Oscillation, float] | None:
    """What the error does beyond what the reference asks for, and what is allowed; None if it is not too much."""
    pieces, known = list(error_detail.stretches(motion.time, motion.error, motion.r)), (motion.period, motion.dither)
    allowed = error_detail.tolerated_amplitude(motion.error, motion.count, motion.whole)
    found = max(error_detail.sustained_oscillation(error, asked, *known) for error, asked in pieces)
    if found.amplitude <= allowed and motion.exceeds:
        found = max(error_detail.irregular_oscillation(error, asked, *known) for error, asked in pieces)
        large = motion.pp > ACCURATE * motion.whole
        if not large and found.frequency < _OF_LOOP / motion.period:
            return None
    return (found, allowed) if found.amplitude > allowed else None


def _disturbed(motion: JudgedMotion) -> Verdict | None:
    """The verdict on an error that is a line, or is made by jumps: by what is behind it."""
    error = f"error {_um(motion.pp)} p-p"
    at_rest = max(FEW_COUNTS * motion.count, _HUNTS * motion.whole)
    # What ends with the first half of a pause was settling.
    hunts = [rest[rest.size // 2 :] for rest in motion.resting() if causes.stick_slip(rest, motion.period)]
    hunting = max((pp for pp in map(peak_to_peak, hunts) if pp > at_rest), default=0.0)
    line = _line(motion)
    if line:
        found, allowed = line
        amplitude = f"with an amplitude of {_um(found.amplitude)}, {error}; allowed: {_um(allowed)}"
        at = causes.Line(found.amplitude, found.frequency)
        if of_mains := causes.mains(motion, at):
            return Verdict(
                words.MAINS,
                f"the mains' hum of {of_mains.at:.1f} Hz moves the platform {amplitude}; it is there at every "
                "speed; look at the grounding and the shields of amplifier and encoder; what is left of a force "
                "control.filters.mains.frequency takes off",
            )
        if waves := causes.locked_to_x(motion):
            return Verdict(
                words.LOCKED_TO_X,
                f"the error has a wave every {1e3 / waves.at:.3g} mm of x {amplitude}; it is at the same places in "
                "every stroke, as cogging or a periodic error of the map; learning.learn takes it off",
            )
    if motion.modes and (line or motion.exceeds) and motion.destabilised():
        modes = " and ".join(f"{one:.0f}" for one in motion.modes)
        return Verdict(
            words.RESONANCE,
            f"the platform's modes at {modes} Hz leave the law no margins: {error}; check "
            f"stage.platform.modes by {causes.MEASURE_RESPONSE}, and design gains for them",
        )
    if motion.exceeds and (drag := _cable(motion)):
        return Verdict(words.INACCURATE, f"{error}; allowed: {_um(motion.largest)}; {drag}")
    slips = False
    # What sticks lags by no more than what stands: a larger error is the loop's.
    if motion.pp <= motion.uncompensated and (line or (not hunting and motion.exceeds)):
        slips = any(causes.stick_slip(motion.error[one.samples], motion.period) for one in motion.strokes)
    if hunting or slips:
        rest = f", {_um(hunting)} at rest; allowed: {_um(at_rest)}" if hunting else f"; allowed: {_um(motion.largest)}"
        lower = ", or lower the static friction" if motion.coulomb else ""
        return Verdict(
            words.STICK_SLIP,
            f"the platform sticks and slips: {error}{rest}; describe its friction (stage.friction.static, coulomb and "
            f"bristle_stiffness; straightcomp friction BAG estimates it){lower}",
        )
    if not line:
        return None
    mode = causes.mode_of(found.frequency, motion.modes)
    if mode is not None:
        return Verdict(
            words.RESONANCE,
            f"the platform's mode at {mode:.0f} Hz is excited: {found.frequency:.0f} Hz {amplitude}; measure it by "
            f"{causes.MEASURE_RESPONSE}, correct stage.platform.modes, and design anew",
        )
    halves = [half for one in motion.strokes for half in np.array_split(motion.error[one.samples], 2)]
    # A loop at its limit changes from one moment to the next.
    weak = motion.unstable_where()
    if not weak and not motion.limited.any() and causes.comes_and_goes(halves, found.frequency, motion.period):
        dithered = (
            "friction is more than the dither overcomes (stage.friction.coulomb, static), or " if motion.dither else ""
        )
        return Verdict(
            words.VIBRATION,
            f"the platform is shaken at {found.frequency:.0f} Hz {amplitude}; that comes and goes like noise, which an "
            "oscillation of the loop does not: look for what shakes the guide or the floor; if nothing does, "
            f"{dithered}the loop has hardly any margins there: measure them by {causes.MEASURE_RESPONSE}",
        )
    of_corner = f"the law is unstable within stage.uncertainty: {weak}; " if weak else ""
    return Verdict(
        words.OSCILLATES,
        f"the loop oscillates at {found.frequency:.0f} Hz {amplitude}; {of_corner}compare "
        "stage.platform.mass, stage.actuator, stage.rate and stage.drive.delay with the machine; straightcomp design "
        "finds gains that fit a description. A mode that is not described is found by "
        f"{causes.MEASURE_RESPONSE}; a line that is the same with other gains comes from outside",
    )


def _unsettled(motion: JudgedMotion) -> str:
    first = motion.disturbed([Stall(motion.time[0], motion.time[0])])
    calm = motion.calm(first)
    if not motion.exceeds or not motion.harmed(first) or calm > motion.largest:
        return ""
    return (
        f"the platform had not reached its reference when the stage began to move: error {_um(motion.pp)} p-p, "
        f"{_um(calm)} after the first moments; allowed: {_um(motion.largest)}; wait before the motion "
        "(stage.motion.settle)"
    )


def _noisy_map(motion: JudgedMotion) -> str:
    """The reference itself asks for most of an error that is too large. It has the noise: an error of more than a
    sound loop makes of the whole reference is the loop's own."""
    if not motion.largest < motion.pp <= error_detail.ASKED * motion.uncompensated or not motion.promised:
        return ""
    with_noise = motion.promised.as_mapped()
    if (
        not with_noise
        or with_noise.pp <= max(motion.largest, HARM * motion.promised.smooth.pp)
        or HARM * with_noise.pp < motion.pp
    ):
        return ""
    return (
        f"the error is {_um(motion.pp)} p-p because the map has the noise of its survey: with it the described stage "
        f"leaves {_um(with_noise.pp)}, with a smooth map {_um(motion.promised.smooth.pp)}; "
        f"allowed: {_um(motion.largest)}; set stage.guide.smooth to auto and repeat the survey's runs, or set it to 1"
    )


def _inaccurate(motion: JudgedMotion) -> str:
    if not motion.exceeds:
        return ""
    if motion.pp <= motion.largest and motion.promised:
        return (
            f"the error has an RMS of {_um(motion.rms)} about its mean where the described stage leaves "
            f"{_um(motion.promised.smooth.rms)}; allowed: {_um(motion.largest_rms)}; it is {_um(motion.pp)} p-p; "
            f"{_cause(motion)}"
        )
    still = f"a platform that stands still would leave {_um(motion.uncompensated)}"
    promised = f"the described stage leaves {_um(motion.promised.smooth.pp)}, and {still}" if motion.promised else still
    return f"the error is {_um(motion.pp)} p-p where {promised}; allowed: {_um(motion.largest)}; {_cause(motion)}"


def _cause(motion: JudgedMotion) -> str:
    if motion.unseen and abs(motion.zero) > ARRIVED_M:
        return f"the zero of x is off by {motion.zero * 1e3:+.3f} mm: home again, or straightcomp map align"
    if motion.unseen:
        return "the encoder of y hardly shows it: it is the encoder's own, between its counts (interpolation)"
    return _cable(motion) or _more_friction(motion) or causes.of_error(motion)


def _cable(motion: JudgedMotion) -> str:
    found = motion.current_stiffness * causes.dragging(motion)
    if not found:
        return ""
    return (
        f"a force of {found:.2g} N turns round with the travel of the stage, and the error is made where the stage "
        "starts and stops: guide a cable or hose so that it does not drag on the platform"
    )


def _more_friction(motion: JudgedMotion) -> str:
    """What the balance of forces says of friction beyond the description's range; empty if it is within, or unknown."""
    columns = motion.time, motion.y, motion.current
    balances = [force_balance(*(of[one.samples] for of in columns)).friction for one in motion.strokes]
    known = [one for one in balances if math.isfinite(one)]
    found = motion.current_stiffness * float(np.median(known)) if known else 0.0
    if not found > motion.friction * motion.coulomb > 0.0:
        return ""
    return (
        f"friction is not as described: {found:.2g} N, allowed: {motion.friction:g} times {motion.coulomb:.2g} N "
        "(stage.friction.coulomb); straightcomp friction BAG estimates it"
    )


def _more_than_promised(motion: JudgedMotion) -> str:
    """What a run says that is in order, but far from its description; empty unless a cause shows."""
    if motion.pp <= FEW_COUNTS * motion.count or motion.stalls or not motion.promised:
        return ""
    promised = motion.promised.smooth.pp
    if motion.pp <= HARM * promised or (cause := _cause(motion)) == causes.UNKNOWN:
        return ""
    drawn = motion.promised.largest(Left(motion.pp, 0.0))
    return f"; the described stage leaves {_um(promised)}: {cause}" if drawn and motion.pp > drawn.pp else ""


_REASONS: Sequence[tuple[str, Callable[[JudgedMotion], str]]] = (
    (words.AT_STOP, _at_stop),
    (words.LEFT_MAP, _left_map),
    (words.OSCILLATES, _unstable),
    (words.SATURATED, _saturated),
    (words.WRONG_GUIDE, _wrong_guide),
    (words.INACCURATE, _unsettled),
    (words.INACCURATE, _noisy_map),
)
"""Why a run is not in order, empty if it is, by verdict, in the order in which they are tried; then come the causes of
:func:`_disturbed`, and at last :func:`_inaccurate`."""


def _in_order(motion: JudgedMotion) -> str:
    if motion.still:
        return f"uncompensated, the reference moved by {_um(motion.travel)} only; error {_um(motion.pp)} p-p"
    mask, raised = motion.disturbed(motion.stalls), ""
    if (calm := motion.calm(mask)) < motion.pp:
        stalls = f"the stalls of the host ({len(motion.stalls)})"
        raised = f", {_um(calm)} without {stalls}" if motion.judgeable(mask) else f", {stalls} included"
    still = f"a platform that stands still would leave {_um(motion.uncompensated)}"
    return f"error {_um(motion.pp)} p-p{raised}; {still}{_more_than_promised(motion)}"


def _um(length: float) -> str:
    return f"{length * 1e6:.3g} µm" if abs(length) < 1e-3 else f"{length * 1e3:.3g} mm"


def _mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
