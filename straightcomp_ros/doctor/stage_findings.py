"""Reads the description of a stage as an engineer would: what does not fit together, why, and what helps."""

import math
from collections.abc import Iterator

from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.control.margins import missing_margin
from straightcomp_ros.doctor.consequences import Consequences, consequences
from straightcomp_ros.doctor.finding import Finding
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import FeedforwardParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.straightness.survey import SurveyError

EASY, FEASIBLE = 0.5, 0.65
"""Of the unstable pole times the dead time: gains with usual margins exist below the first, none beyond the second."""
_GAIN_LOW, _GAIN_HIGH = 0.7, 1.5
"""Least gain margins of a loop that deserves trust, to either side."""
_SHARE_OF_LIMIT = 0.7
"""Of the current limit for the largest steady demand: the rest is for the law's corrections."""
_BUS_FULL = 0.8


def stage_findings(
    stage: StageParameters, control: ControlParameters, tracking: FeedforwardParameters
) -> Iterator[Finding]:
    """Check the description with the law of ``control`` and the feedforward's ``tracking``; each check is a finding."""
    try:
        straightness = load_map(stage.guide)
    except SurveyError as error:
        yield Finding("survey", "fail", str(error))
        return
    found = consequences(stage, control, straightness)
    yield _span(stage, straightness)
    yield _correction(stage, found)
    yield _reference(stage, found, tracking)
    yield _pole(stage, found)
    yield _loop(control, stage, found)
    yield _force(stage, found)
    yield _quanta(stage, found)
    yield _bus(stage, found)


def _span(stage: StageParameters, straightness: StraightnessMap) -> Finding:
    first, last = straightness.span
    start, end = stage.motion.start, stage.motion.start + stage.motion.stroke
    detail = (
        f"survey from {first * 1e3:.1f} to {last * 1e3:.1f} mm, strokes from {start * 1e3:.1f} to {end * 1e3:.1f} mm"
    )
    beyond = max(first - start, end - last)
    if beyond > 1e-6:
        state = "fail" if beyond > stage.guide.runout else "warn"
        return Finding("survey", state, detail, "Survey the whole stroke, or shorten stage.motion.stroke.")
    return Finding("survey", "ok", detail)


def _correction(stage: StageParameters, found: Consequences) -> Finding:
    detail = (
        f"correction of {found.correction * 1e6:.1f} µm to each side; travel {stage.guide.travel * 1e6:g} µm, "
        f"stop at {stage.platform.stop * 1e6:g} µm"
    )
    if stage.guide.travel >= stage.platform.stop:
        return Finding("travel", "fail", detail, "stage.guide.travel must lie inside stage.platform.stop.")
    narrowest = stage.actuator.air_gap * (1.0 - stage.uncertainty.air_gap)
    if narrowest <= stage.platform.stop:
        detail += f", but the air gap may be {narrowest * 1e6:.0f} µm"
        return Finding("travel", "warn", detail, "Measure the air gap and lower stage.uncertainty.air_gap.")
    return Finding("travel", "ok", detail)


def _reference(stage: StageParameters, found: Consequences, tracking: FeedforwardParameters) -> Finding:
    # The stage's acceleration changes within a sample; the tracking filter knows it late by about 1/(2π f).
    late = 1.0 / (2.0 * math.pi * tracking.bandwidth)
    slope = found.reference_speed / stage.motion.speed
    wrong = slope * stage.motion.acceleration * late
    error = wrong * found.dead_time
    detail = (
        f"ṙ up to {found.reference_speed * 1e6:.0f} µm/s, r̈ up to {found.reference_acceleration:.3g} m/s²; at the ends "
        f"of a ramp ṙ errs by {wrong * 1e6:.1f} µm/s, {error * 1e9:.0f} nm within the dead time"
    )
    if error > stage.encoder.y_resolution:
        remedy = "Raise feedforward.bandwidth (node feedforward), or accelerate the stage less."
        return Finding("reference", "warn", detail, remedy)
    return Finding("reference", "ok", detail)


def _pole(stage: StageParameters, found: Consequences) -> Finding:
    detail = (
        f"the magnets' negative stiffness of {found.position_stiffness / 1e3:.3g} kN/m gives a pole at "
        f"{found.unstable_pole:.0f} 1/s; dead time {found.dead_time * 1e3:.2f} ms; product {found.difficulty:.2f}"
    )
    if found.difficulty < EASY:
        return Finding("instability", "ok", detail)
    # With what is left to the dead time at this pole.
    longest = EASY / found.unstable_pole
    bias = stage.actuator.bias_current * (EASY / found.difficulty)
    remedy = (
        f"Below {EASY:g} gains with usual margins exist: shorten the dead time to {longest * 1e3:.2f} ms (rate, delay, "
        f"amplifier), or lower stage.actuator.bias_current to {bias:.2g} A, or add mass."
    )
    return Finding("instability", "fail" if found.difficulty >= FEASIBLE else "warn", detail, remedy)


def _loop(control: ControlParameters, stage: StageParameters, found: Consequences) -> Finding:
    margins, law = found.margins, control.law
    if margins is None:
        return Finding("loop", "ok", f"law {law} switches at rest: it has no linear margins there")
    missing = missing_margin(control, stage)
    if missing is not None:
        return Finding("loop", "fail", missing, "The controller refuses these gains: design others.")
    detail = (
        f"law {law}: stable for gains from {margins.gain_low:.2f} to {margins.gain_high:.2f}, phase "
        f"{margins.phase:.0f}°, delay up to {margins.longest_delay * 1e3:.2f} ms"
    )
    if margins.gain_low > _GAIN_LOW or margins.gain_high < _GAIN_HIGH:
        return Finding("loop", "warn", detail, "The margins are thin: straightcomp design finds gains for this stage.")
    return Finding("loop", "ok", detail)


def _force(stage: StageParameters, found: Consequences) -> Finding:
    limit, drive, bias = stage.actuator.current_limit, stage.drive.current_range, stage.actuator.bias_current
    detail = (
        f"friction, pull and acceleration need up to {found.holding_current:.3g} A; limit {limit:g} A, "
        f"converter {drive:g} A, bias {bias:g} A"
    )
    if limit > min(drive, bias):
        smaller = "the converter's range" if drive < bias else "the bias current, beyond which one magnet only pulls"
        return Finding("force", "warn", detail, f"stage.actuator.current_limit is above {smaller}.")
    if found.holding_current > limit:
        return Finding("force", "fail", detail, "Raise current limit and bias, or reduce friction, mass or speed.")
    if found.holding_current > _SHARE_OF_LIMIT * limit:
        return Finding("force", "warn", detail, "Little is left for the law's corrections: raise the current limit.")
    return Finding("force", "ok", detail)


def _quanta(stage: StageParameters, found: Consequences) -> Finding:
    count = stage.encoder.y_resolution
    detail = (
        f"a count of {count * 1e9:g} nm leaves some {found.encoder_floor * 1e9:.0f} nm p-p at best; a step of the D/A "
        f"converter is {found.dac_force * 1e3:.3g} mN, or {found.dac_displacement * 1e9:.3g} nm against the bristles"
    )
    if found.dac_displacement > count:
        remedy = "The D/A converter is coarser than the encoder: use more bits, or a smaller range or gain."
        return Finding("quanta", "warn", detail, remedy)
    return Finding("quanta", "ok", detail)


def _bus(stage: StageParameters, found: Consequences) -> Finding:
    detail = (
        f"at {stage.rate} Hz classic CAN (1 Mbit/s) is busy by {found.can_load:.0%}, CAN FD (5 Mbit/s) by "
        f"{found.can_fd_load:.0%}"
    )
    if found.can_fd_load > _BUS_FULL:
        return Finding("bus", "warn", detail, "No CAN bus carries this rate: use another link, or a lower rate.")
    if found.can_load > _BUS_FULL:
        return Finding("bus", "ok", f"{detail}: only CAN FD carries it")
    return Finding("bus", "ok", detail)
