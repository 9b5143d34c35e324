"""The verdict on a run: in order, or the one reason that explains best why its figures say nothing about the machine.

The reasons are tried from the most specific to the most general, because one leads to another: a stalled host makes the
platform oscillate, an oscillation saturates the current, and each of them makes the run inaccurate.

A run is judged by what its stage was promised (:mod:`straightcomp_ros.offline.promise`): the error of the described
machine under the same law, and a map as good as its described noise. An error of half of what a platform that stands
still would leave is too large whatever was promised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis import causes, error_detail
from straightcomp_ros.analysis import judgement as words
from straightcomp_ros.analysis.interruption import Stall
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import RESTING, residual_over
from straightcomp_ros.analysis.record import (
    AT_LIMIT,
    Array,
    MetricsError,
    ReferenceMap,
    Stroke,
    StrokeRecord,
    group_means,
    motion_of,
    runs_of,
)
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import least_squares_residual, peak_to_peak

if TYPE_CHECKING:
    from straightcomp_ros.offline.promise import Promise


def bounds_of(
    parameters: Mapping[str, Mapping[str, Any]], straightness: StraightnessMap | None = None
) -> dict[str, Any]:
    """The bounds of a :class:`JudgedMotion` by name, from parameters of each node alone, by dotted name, as a bag has
    them, and from the map.

    A node that is there has its defaults for what is not named; of one that is not, nothing is known. A board on CAN
    reports neither its stop nor its converter, unless it is the emulator.
    """
    bounds: dict[str, Any] = {}
    shipped, limits = StageParameters(), []
    if "controller" in parameters:
        limits.append(parameters["controller"].get("stage.actuator.current_limit", shipped.actuator.current_limit))
    driver = parameters.get("driver", {"hardware": "unknown"})
    if is_simulated(driver):
        bounds["stop"] = float(driver.get("stage.platform.stop", shipped.platform.stop))
        limits.append(recorded_drive(driver).largest_current)
    if limits:
        bounds["current_limit"] = float(min(limits))
    if straightness is not None:
        runout = float(parameters.get("feedforward", {}).get("stage.guide.runout", shipped.guide.runout))
        bounds["span"] = (straightness.span[0] - runout, straightness.span[1] + runout)
    if "controller" in parameters:
        for name in ("friction", "sensor_noise", "map_noise"):
            known = parameters["controller"].get(f"stage.uncertainty.{name}", getattr(shipped.uncertainty, name))
            bounds[name] = float(known)
        modes = (parameters["controller"].get(f"stage.platform.modes.{one}.frequency") for one in ("first", "second"))
        bounds["modes"] = tuple(float(one) for one in modes if one)
    return bounds


def is_simulated(driver: Mapping[str, Any]) -> bool:
    """Whether the driver with these parameters by dotted name has a simulated stage, if need be behind a board."""
    return driver.get("hardware", "simulated") == "simulated" or bool(driver.get("can.simulated_stage", False))


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
_HARM = 2.0
"""A disturbance did harm if the error is larger by this factor, p-p, than without the samples that it disturbed."""
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
_SIGMAS = 8.0
"""Standard deviations, p-p, of what the noise of a survey leaves in its map: of 1,000 surveys with 200 points, one
exceeds it."""
_PIECES, _READINGS = 200, 5
"""Pieces of x over which the readings of a displacement sensor are averaged, and the least mean number in each."""
_MAP_COUNTS = 2.0
"""Counts of the encoder, p-p, below which an error of the map is not seen."""
_ACCURATE = 0.5
"""Largest error relative to the uncompensated deviation, both p-p, whatever was promised."""
_FEW_COUNTS = 3.0
"""Counts of the encoder, p-p, which the best law leaves: no less is asked for on a nearly straight guide."""
_OF_LOOP = 0.0125
"""Frequency relative to the rate from which an error without a held line is the loop's: slower ones it rejects, and
what then is left of a disturbance has no line either."""
_HUNTS = 0.02
"""Least motion at rest relative to the uncompensated deviation, both p-p, that is hunting."""
STILL = 0.1e-6
"""Travel in m of a reference that asks for nothing: the run is uncompensated. Twenty times less than the best guide."""
_STILL_SHARE = 0.01
"""The same relative to the true guide's deviation."""


class GuideFit(NamedTuple):
    """How the guide's true deviation fits the map, from the least squares line, in m: p-p of the guide, p-p of what a
    platform that follows the map exactly would leave, and why it does."""

    guide_pp: float
    left_pp: float
    cause: str = ""
    noise: float = 0.0  # standard deviation of the sensor's noise that is left


@dataclass(frozen=True, eq=False)
class JudgedMotion:
    """The motion of a run, from its first to its last sample, pauses included; arrays (n,), in s, m and A. Positions
    and error are the true ones if they are known, otherwise as the encoders see them. Unknown bounds are infinite."""

    time: Array
    x: Array
    y: Array
    r: Array
    current: Array
    error: Array  # r − y
    count: float  # one count of the encoder of y
    fit: GuideFit | None = None  # of guide and map; None where the guide is not known
    stalls: Sequence[Stall] = ()  # of the host within the motion
    current_limit: float = math.inf  # largest |i_c| that the law may command and the D/A converter can
    stop: float = math.inf  # the platform's mechanical stop at ± this position
    span: tuple[float, float] = (-math.inf, math.inf)  # of x in which the map's reference follows the guide or runs out
    late: str = ""  # that commands came later than described, as of `late_commands`
    by_encoder: bool = False  # whether y and the error are the encoder's
    promise: Callable[[], Promise | None] = lambda: None  # what the description leaves on this motion
    # Of the description, see `UncertaintyParameters`.
    friction: float = 2.0
    sensor_noise: float = 0.5
    map_noise: float = 0.02e-6
    modes: Sequence[float] = ()  # Hz, described resonances of the platform

    @cached_property
    def period(self) -> float:
        """Sampling period in s."""
        return float(np.median(np.diff(self.time)))

    @property
    def recovery(self) -> int:
        """Samples in which the error of a disturbance decays."""
        return max(round(RECOVERY / self.period), RECOVERY_SAMPLES)

    @cached_property
    def pp(self) -> float:
        """Error in m, peak to peak."""
        return peak_to_peak(self.error)

    @cached_property
    def travel(self) -> float:
        """Of the reference in m, peak to peak."""
        return peak_to_peak(self.r)

    @property
    def uncompensated(self) -> float:
        """What a platform that stands still would leave: p-p of the reference, or of the guide if that is more."""
        return max(self.travel, self.fit.guide_pp if self.fit else 0.0)

    @property
    def still(self) -> bool:
        """Whether the reference asks for nothing: the run is uncompensated."""
        guide = self.fit.guide_pp if self.fit else 0.0
        return self.travel <= max(STILL, self.count, _STILL_SHARE * guide)

    @cached_property
    def promised(self) -> Promise | None:
        """What the stage was promised; asked for only where the error is more than the encoder's few counts."""
        return self.promise()

    @cached_property
    def largest(self) -> float:
        """Largest error in m, p-p, of a run that is in order; infinite for one that is uncompensated."""
        least = _FEW_COUNTS * self.count
        if self.still:
            return math.inf
        if self.pp <= least:
            return least
        largest = max(_ACCURATE * self.uncompensated, least)
        if not self.promised:
            return min(largest, max(self.uncompensated, self.count))
        # The error grows at most as the friction. The encoder's noise, and what it rounds, add to both sides.
        rounded = 2.0 * self.sensor_noise + (2.0 if self.by_encoder else 1.0)
        return min(largest, max(least, self.friction * self.promised.smooth + rounded * self.count))

    @property
    def largest_of_map(self) -> float:
        """Largest deviation of the guide from the map in m, p-p."""
        noise = math.hypot(self.map_noise, self.fit.noise if self.fit else 0.0)
        return max(_MAP_COUNTS * self.count, _SIGMAS * noise)

    @cached_property
    def strokes(self) -> Sequence[Stroke]:
        """Of the stage; none where its motion cannot be told."""
        try:
            return motion_of(self.time, self.x).strokes
        except MetricsError:
            return ()

    def resting(self) -> list[Array]:
        """The error (m,) in each pause between strokes, from :data:`RESTING` after a stroke on."""
        begins = [int(np.searchsorted(self.time, self.time[one.stop - 1] + RESTING)) for one in self.strokes]
        pauses = zip(begins, self.strokes[1:], strict=False)
        return [self.error[begin : following.start] for begin, following in pauses if begin < following.start]

    def disturbed(self, times: Sequence[Stall]) -> NDArray[np.bool_]:
        """The samples (n,) in any of these times, or so soon after that their error has not decayed yet."""
        mask = np.zeros(self.time.size, dtype=bool)
        for start, end in times:
            begin, stop = np.searchsorted(self.time, (start, end))
            mask[begin : stop + self.recovery] = True
        return mask

    def calm(self, mask: NDArray[np.bool_]) -> float:
        """Error p-p in m without the samples ``mask`` (n,), if that leaves any; with all samples otherwise."""
        return self.pp if mask.all() else peak_to_peak(self.error[~mask])

    def harmed(self, mask: NDArray[np.bool_]) -> bool:
        """Whether the error p-p was made in the samples ``mask`` (n,): `_HARM` times less, and more than a count less,
        in the others."""
        calm = self.calm(mask)
        return self.pp > _HARM * calm and self.pp - calm > self.count


def judged_run(
    record: StrokeRecord,
    reference: ReferenceMap,
    parameters: Mapping[str, Mapping[str, Any]],
    straightness: StraightnessMap | None = None,
    stalls: Sequence[Stall] = (),
    latency: Array | None = None,
    sensor: Array | None = None,
) -> Verdict:
    """The verdict on ``record``, whose platform was to follow ``reference``, made from the map ``straightness`` if that
    is known. ``parameters`` as in :func:`bounds_of`, ``stalls`` on the record's clock, ``latency`` as of
    :func:`late_commands`, ``sensor`` the guide's deviation (n,) in m by a displacement sensor at the record's samples,
    up to a constant, NaN where it has none. MetricsError if the stage does not move."""
    run = record.moving
    truth, first, last = run.true_error(reference), run.time[0], run.time[-1]
    return verdict_of(
        JudgedMotion(
            time=run.time,
            x=run.x,
            y=run.y if run.true_y is None else run.true_y,
            r=run.r,
            current=run.current,
            error=run.r - run.y if truth is None else truth,
            count=encoder_count(run.y),
            by_encoder=truth is None,
            fit=_guide_fit(record, reference, straightness, sensor),
            stalls=tuple(stall for stall in stalls if stall.end >= first and stall.start <= last),
            promise=lambda: _promise(record, parameters, straightness),
            **bounds_of(parameters, straightness),
            late="" if latency is None else late_commands(latency, parameters.get("driver", {})),
        )
    )


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


def encoder_count(readings: Array) -> float:
    """The smallest step between two different readings (n,) in m; 0 if all are the same."""
    steps = np.diff(np.unique(readings))
    steps = steps[steps > _COUNTED]
    return float(steps.min()) if steps.size else 0.0


def _promise(
    record: StrokeRecord, parameters: Mapping[str, Mapping[str, Any]], straightness: StraightnessMap | None
) -> Promise | None:
    # Only here: it loads what simulates a stroke, which most runs do not need.
    from straightcomp_ros.offline.promise import promise_of

    return promise_of(record, parameters, straightness)


def _guide_fit(
    record: StrokeRecord, reference: ReferenceMap, straightness: StraightnessMap | None, sensor: Array | None
) -> GuideFit | None:
    if record.true_x is not None and record.guide is not None:
        x, noise, followed = (
            record.true_x[record.motion.samples()],
            0.0,
            record.guide + record.followed(reference),
        )
        guide, left = (residual_over(record.true_x, values, record) for values in (record.guide, followed))
    else:
        moving = record.motion.samples()
        known = moving[:0] if sensor is None else moving[np.isfinite(sensor[moving])]
        if sensor is None or known.size < _READINGS * _PIECES:
            return None
        # Means over pieces of x have little of the sensor's noise, and what they have is known from its spread.
        x, readings = record.x[known], sensor[known]
        piece = np.minimum(((x - x.min()) / np.ptp(x) * _PIECES).astype(np.intp), _PIECES - 1)
        (x, guide), square = group_means(x, readings, piece), group_means(x, readings**2, piece)[1]
        noise = float(np.sqrt(np.mean(np.maximum(square - guide**2, 0.0)) * guide.size / known.size))
        guide, left = (least_squares_residual(x, one) for one in (guide, guide + reference.evaluate(x)[0]))
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
    return (
        f"the servo works, the computer was busy: error {_um(calm)} p-p, but {stalls} made it {_um(motion.pp)}; "
        f"allowed: {_HARM:g} times; {remedy}"
    )


def _at_stop(motion: JudgedMotion) -> str:
    farthest = float(np.abs(motion.y).max())
    # The encoder rounds, and samples only see where the platform was at their own moments.
    if farthest < motion.stop - motion.count:
        return ""
    return (
        f"|y| reached {_um(farthest)}; allowed: inside the mechanical stop at {_um(motion.stop)}; check where the "
        "platform starts, the current limit, and by straightcomp robustness whether the law is stable on this machine"
    )


def _left_map(motion: JudgedMotion) -> str:
    low, high, (first, last) = float(motion.x.min()), float(motion.x.max()), motion.span
    if low >= first and high <= last:
        return ""
    return (
        f"the stage moved from {_mm(low)} to {_mm(high)}; allowed: {_mm(first)} to {_mm(last)}, the "
        "survey and its run-out; shorten the motion, or survey the whole guide"
    )


def _saturated(motion: JudgedMotion) -> str:
    limited = np.sign(motion.current) * (np.abs(motion.current) >= AT_LIMIT * motion.current_limit)
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
    pieces = list(error_detail.stretches(motion.time, motion.error, motion.r))
    allowed = error_detail.tolerated_amplitude(motion.error, motion.count, motion.uncompensated)
    found = max(error_detail.sustained_oscillation(error, reference, motion.period) for error, reference in pieces)
    if found.amplitude <= allowed and motion.pp > motion.largest:
        found = max(error_detail.irregular_oscillation(error, reference, motion.period) for error, reference in pieces)
        large = motion.pp > _ACCURATE * motion.uncompensated
        if not large and found.frequency < _OF_LOOP / motion.period:
            return None
    return (found, allowed) if found.amplitude > allowed else None


def _disturbed(motion: JudgedMotion) -> Verdict | None:
    """The verdict on an error that is a line, or is made by jumps: by what is behind it."""
    error = f"error {_um(motion.pp)} p-p"
    at_rest = max(_FEW_COUNTS * motion.count, _HUNTS * motion.uncompensated)
    hunts = [rest for rest in motion.resting() if causes.stick_slip(rest, motion.period)]
    hunting = max((pp for pp in map(peak_to_peak, hunts) if pp > at_rest), default=0.0)
    line = _line(motion)
    if line:
        found, allowed = line
        amplitude = f"with an amplitude of {_um(found.amplitude)}, {error}; allowed: {_um(allowed)}"
        at = causes.Line(found.amplitude, found.frequency)
        if of_mains := causes.mains(motion.time, motion.error, at, motion.resting()):
            return Verdict(
                words.MAINS,
                f"the mains' hum of {of_mains.at:.1f} Hz moves the platform {amplitude}; it is there at every "
                "speed; look at the grounding and the shields of amplifier and encoder",
            )
        if waves := causes.locked_to_x(motion.time, motion.x, motion.error, motion.strokes, at):
            return Verdict(
                words.LOCKED_TO_X,
                f"the error has a wave every {_mm(1.0 / waves.at)} of x {amplitude}; it is at the same places in "
                "every stroke, as cogging or a periodic error of the map; learning.learn takes it off",
            )
    slips = False
    # What sticks lags by no more than what stands: a larger error is the loop's.
    if motion.pp <= motion.uncompensated and (line or (not hunting and motion.pp > motion.largest)):
        slips = any(causes.stick_slip(motion.error[one.samples], motion.period) for one in motion.strokes)
    if hunting or slips:
        rest = f", {_um(hunting)} at rest; allowed: {_um(at_rest)}" if hunting else f"; allowed: {_um(motion.largest)}"
        return Verdict(
            words.STICK_SLIP,
            f"the platform sticks and slips: {error}{rest}; describe its friction (stage.friction.static, coulomb and "
            "bristle_stiffness; straightcomp friction BAG estimates it), or lower the static friction",
        )
    if not line:
        return None
    mode = causes.mode_of(found.frequency, motion.modes)
    if mode is not None:
        return Verdict(
            words.RESONANCE,
            f"the platform's mode at {mode:.0f} Hz is excited: {found.frequency:.0f} Hz {amplitude}; measure it by "
            "straightcomp frequency-response, correct stage.platform.modes, and design anew",
        )
    return Verdict(
        words.OSCILLATES,
        f"the loop oscillates at {found.frequency:.0f} Hz {amplitude}; compare stage.platform.mass, stage.actuator, "
        "stage.rate and stage.drive.delay with the machine; straightcomp design finds gains that fit a description",
    )


def _noisy_map(motion: JudgedMotion) -> str:
    """The reference itself asks for most of an error that is too large. It has the noise: an error of more than a
    sound loop makes of the whole reference is the loop's own."""
    if not motion.largest < motion.pp <= error_detail.ASKED * motion.uncompensated or not motion.promised:
        return ""
    with_noise = motion.promised.as_mapped
    if with_noise <= max(motion.largest, _HARM * motion.promised.smooth) or _HARM * with_noise < motion.pp:
        return ""
    return (
        f"the error is {_um(motion.pp)} p-p because the map has the noise of its survey: with it the described stage "
        f"leaves {_um(with_noise)}, with a smooth map {_um(motion.promised.smooth)}; allowed: {_um(motion.largest)}; "
        "set stage.guide.smooth to auto and repeat the survey's runs, or set it to 1"
    )


def _inaccurate(motion: JudgedMotion) -> str:
    if motion.pp <= motion.largest:
        return ""
    still = f"a platform that stands still would leave {_um(motion.uncompensated)}"
    promised = f"the described stage leaves {_um(motion.promised.smooth)}, and {still}" if motion.promised else still
    cause = causes.of_error(motion.time, motion.x, motion.r, motion.error, motion.strokes, motion.resting())
    return f"the error is {_um(motion.pp)} p-p where {promised}; allowed: {_um(motion.largest)}; {cause}"


_REASONS: Sequence[tuple[str, Callable[[JudgedMotion], str]]] = (
    (words.AT_STOP, _at_stop),
    (words.LEFT_MAP, _left_map),
    (words.SATURATED, _saturated),
    (words.WRONG_GUIDE, _wrong_guide),
    (words.INACCURATE, _noisy_map),
)
"""Why a run is not in order, empty if it is, by verdict, in the order in which they are tried; then come the causes of
:func:`_disturbed`, and at last :func:`_inaccurate`."""


def _in_order(motion: JudgedMotion) -> str:
    if motion.still:
        return f"uncompensated, the reference moved by {_um(motion.travel)} only; error {_um(motion.pp)} p-p"
    calm = motion.calm(motion.disturbed(motion.stalls))
    raised = f", {_um(calm)} without the stalls of the host ({len(motion.stalls)})" if calm < motion.pp else ""
    return f"error {_um(motion.pp)} p-p{raised}; a platform that stands still would leave {_um(motion.uncompensated)}"


def _um(length: float) -> str:
    return f"{length * 1e6:.3g} µm" if abs(length) < 1e-3 else f"{length * 1e3:.3g} mm"


def _mm(length: float) -> str:
    return f"{length * 1e3:.6g} mm"
