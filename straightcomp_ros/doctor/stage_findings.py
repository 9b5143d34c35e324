"""Reads the description of a stage and the frames of its board like an engineer: what follows, what does not fit."""

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from straightcomp_ros.control.laws import (
    OPEN_LOOP,
    ControlParameters,
    ObserverDesign,
    described_state,
    dither_of,
    make_law,
    needs_dither,
)
from straightcomp_ros.control.margins import Margins, loop_margins, missing_margin, unstable_where
from straightcomp_ros.doctor import Finding, State, judged
from straightcomp_ros.hardware.can.board_dbc import Wire, gaps
from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import EXTENDED_ID
from straightcomp_ros.hardware.can.frames import Frames
from straightcomp_ros.model.actuator import MU_0
from straightcomp_ros.model.motion import reach
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters, DriverNodeParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import FeedforwardParameters, handover
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.straightness.smoothing import ROUNDING
from straightcomp_ros.straightness.survey_header import WAYS, SurveyError

EASY, FEASIBLE = 0.5, 0.65
"""Of the unstable pole times the dead time: gains with usual margins exist below the first, none beyond the second."""
FLOOR_COUNTS = 1.1
"""Least p-p error in counts of the encoder that any law here with margins has left (docs/evidence/accuracy.md)."""
_GRID = 0.1e-3
"""m; far below the pitch of any survey."""
_GAIN_LOW, _GAIN_HIGH = 0.7, 1.5
"""Least gain margins of a loop that deserves trust, to either side."""
_QUIET_STICTION = 2.6
"""Static friction over the described Coulomb friction up to which dither leaves at most 0.3 µm (shipped stage, all but
single soft blocks, docs/evidence/accuracy.md)."""
_SHARE_OF_LIMIT = 0.7
"""Of the current limit for the largest steady demand: the rest is for the law's corrections."""
_BUS_FULL = 0.8
_STRAIGHT = 0.1e-6
"""Correction in m to each side below which a guide hardly needs one: such a survey is rather of another unit."""
_USUAL = {
    "motion.settle": (0.02, 19.9),
    "motion.pause": (0.05, 49.9),
    "guide.runout": (1.01e-3, 0.99),
    "guide.reversal": (0.05e-3, 0.049),
    "platform.modes.first.frequency": (5.0, 4900.0),
    "platform.modes.first.damping": (1e-3, 0.99),
    "platform.modes.first.coil": (0.02, 19.9),
    "platform.modes.first.encoder": (0.02, 19.9),
    "platform.modes.first.frequency_error": (6e-4, 0.5),
    "platform.modes.first.participation_error": (1e-3, 0.9),
    "friction.stribeck_velocity": (4e-6, 3.9e-3),
    "drive.delay": (0.0101, 10.0),
    "encoder.y_resolution": (1e-9, 0.99e-6),
    "uncertainty.mass": (1e-3, 0.9),
    "uncertainty.force": (1e-3, 0.9),
    "uncertainty.air_gap": (1e-3, 0.9),
    "uncertainty.sensor_noise": (0.02, 19.9),
    "uncertainty.shortest_delay": (0.0101, 10.0),
    "uncertainty.longest_delay": (0.0101, 10.0),
    "uncertainty.jitter": (5e-4, 0.4),
    "uncertainty.map_noise": (1e-9, 0.99e-6),
}
"""Of stages of this kind, in SI; a fact of zero is left out of the machine on purpose. Both ends are less than a factor
of 1000 apart, or one of them is the parameter's own, so that a wrong prefix of a unit is outside."""
_USUAL |= {name.replace("first", "second"): usual for name, usual in _USUAL.items() if ".first." in name}


class Consequences:
    """What an engineer would compute by hand before the first run from the description of a ``stage``, with the law of
    ``control`` and the map of its guide; SI units."""

    def __init__(self, stage: StageParameters, control: ControlParameters, straightness: StraightnessMap) -> None:
        actuator, friction, motion, mass = stage.actuator, stage.friction, stage.motion, stage.platform.mass
        low, high = reach(motion)
        x = low + np.arange(0.0, high - low + _GRID, _GRID)
        tables = [straightness.evaluate(x, way) for way in WAYS]
        r, slope, curvature = (float(np.abs(values).max()) for values in zip(*tables, strict=True))
        apart = handover(straightness.hysteresis, motion.acceleration, straightness.reversal)
        pull = stage.negative_stiffness
        self.unstable_pole = math.sqrt(max(0.0, pull) / mass)  # of the platform in magnets and flexure, 1/s
        # Gains with margins exist below some 0.5, from 0.65 none.
        self.difficulty = self.unstable_pole * stage.dead_time
        self.dac_force = stage.drive.current_step * actuator.current_stiffness  # of one step of the D/A converter
        # Of one step, against the bristles; without dry friction there is only mass, until the loop answers.
        compliance = 1.0 / friction.bristle_stiffness if friction.static > 0.0 else 0.5 / mass * stage.dead_time**2
        self.dac_displacement = self.dac_force * compliance
        self.breakaway_current = friction.static / actuator.current_stiffness  # that overcomes static friction
        self.correction = r  # largest |r| over the stroke
        self.reference_speed = slope * motion.speed + apart[0]  # largest |ṙ| of a stroke
        # Largest |r̈|: at cruise, at the ends of the ramps, and where tables are handed over.
        self.reference_acceleration = curvature * motion.speed**2 + slope * motion.acceleration + apart[1]
        friction_force = friction.static + friction.viscous * slope * motion.speed
        force = friction_force + abs(pull) * r + mass * self.reference_acceleration
        # For friction, the magnets' pull at the largest correction, and its acceleration.
        self.holding_current = force / actuator.current_stiffness
        self.encoder_floor = FLOOR_COUNTS * stage.encoder.y_resolution  # p-p error that its count leaves at best
        # Fraction of the time for which a bus of 1 Mbit/s is busy, and one of FD with 5 Mbit/s.
        self.can_load, self.can_fd_load = (
            sum(bus_load(CanParameters(fd=bool(data)).make_wire(), stage.rate, 1e6, data).values())
            for data in (0.0, 5e6)
        )
        self.law_state, law = described_state(control, stage)
        # Of a law that has a linearisation at rest, in this state, and closes the loop.
        self.margins: Margins | None = None
        self.unstable_where = unstable_where(control, stage)  # in words
        with contextlib.suppress(ValueError):
            if control.law != OPEN_LOOP:
                self.margins = loop_margins(make_law(law, stage), stage)


def stage_findings(controller: ControllerNodeParameters, tracking: FeedforwardParameters) -> Iterator[Finding]:
    """Check the description with the law of the ``controller`` and the feedforward's ``tracking``."""
    stage, control = controller.stage, controller.control
    try:
        straightness = load_map(stage.guide)
    except SurveyError as error:
        yield Finding("survey", "fail", str(error))
        return
    found = Consequences(stage, control, straightness)
    facts = to_mapping(stage)
    unusual = [
        f"stage.{name} {facts[name]:g} (usual: {low:g} to {high:g})"
        for name, (low, high) in _USUAL.items()
        if facts[name] and not low <= abs(facts[name]) <= high
    ]
    unusual += [
        f"{value:.3g} {words} (usual: {low:g} to {high:g}; stage.{', stage.'.join(names.split())})"
        for words, value, low, high, names in _related(stage, straightness)
        if value and not low <= value <= high
    ]
    detail = ", ".join(unusual)
    remedy = "Check the units: all are SI, as kg, m, N and A."
    yield judged("units", not detail, detail or "every fact is usual for such a stage", remedy)
    yield from _guide_findings(stage, straightness, found)
    yield _reference(controller, straightness, found, stage.tracking(tracking, straightness).bandwidth)
    yield from _loop_findings(stage, control, found)
    yield from _drive_findings(stage, found)


def _related(stage: StageParameters, straightness: StraightnessMap) -> Iterator[tuple[str, float, float, float, str]]:
    """What facts make together: the words behind a value, the value, what is usual from and to, and the facts' names.

    A platform may have grams or tons, but then its magnets fit. A value of zero: the stage has no such fact."""
    motion, platform, magnets, friction = stage.motion, stage.platform, stage.actuator, stage.friction
    drive, mass, limit = stage.drive, platform.mass, magnets.current_limit
    ramp, span = motion.speed / motion.acceleration, straightness.span[1] - straightness.span[0]
    if not motion.file:
        yield "of the survey in a stroke", abs(motion.stroke) / span, 1.5e-3, 2.0, "motion.stroke"
    yield "s to the cruising speed", ramp, 5e-3, 4.9, "motion.speed motion.acceleration"
    faster = motion.highest_speed / motion.speed
    yield "times the cruising speed as the highest", faster, 1.0, 2100.0, "motion.highest_speed"
    if motion.jerk:
        share = motion.acceleration / motion.jerk / ramp
        yield "of a ramp until its acceleration", share, 1.01e-3, 1.0, "motion.jerk"
    force = magnets.current_stiffness * limit
    facts = "platform.mass actuator.turns actuator.pole_area actuator.air_gap actuator.current_limit"
    yield "m/s² by the magnets", force / mass, 0.3, 299.0, facts
    flux = MU_0 * magnets.turns * magnets.bias_current / (2.0 * magnets.air_gap)
    yield "T in the air gap by the bias", flux, 5e-3, 1.6, "actuator.turns actuator.bias_current actuator.air_gap"
    stiffness = platform.stiffness / stage.actuator.position_stiffness
    yield "times the magnets' stiffness by the flexure", stiffness, 0.05, 49.0, "platform.stiffness"
    if platform.stiffness:
        ratio = 0.5 * platform.damping / math.sqrt(platform.stiffness * mass)
        yield "as damping ratio of the flexure", ratio, 2e-3, 1.9, "platform.damping"
    if friction.coulomb:
        stiction = friction.static / friction.coulomb
        yield "times Coulomb friction as static friction", stiction, 1.0, 10.0, "friction.static"
    bending = friction.static / friction.bristle_stiffness * 1e6
    yield "µm until the platform slides", bending, 0.02, 19.0, "friction.static friction.bristle_stiffness"
    ratio = 0.5 * friction.bristle_damping / math.sqrt(friction.bristle_stiffness * mass)
    yield "as damping ratio of the bristles", ratio, 0.01, 9.9, "friction.bristle_damping"
    if friction.viscous:
        yield "s until viscous friction stops the platform", mass / friction.viscous, 0.02, 19.9, "friction.viscous"
    yield "times the current limit by the converter", drive.current_range / limit, 0.5, 100.0, "drive.gain"
    # Counts of x from 1 nm to 2 µm are usual, which is more than a factor of 1000: at its ends the count of y shows a
    # wrong unit of x.
    count = stage.encoder.x_resolution
    if not 2e-9 <= count <= 1.9e-6:
        counts = count / stage.encoder.y_resolution
        yield "counts of y as the count of x", counts, 0.2, 199.0, "encoder.x_resolution encoder.y_resolution"
    yield "times the rate as the amplifier's bandwidth", drive.bandwidth / stage.rate, 0.02, 19.0, "drive.bandwidth"


def _guide_findings(stage: StageParameters, straightness: StraightnessMap, found: Consequences) -> Iterator[Finding]:
    """Survey and travel."""
    motion, stop = stage.motion, stage.platform.stop
    first, last = straightness.span
    start, end = reach(motion)
    detail = (
        f"survey from {first * 1e3:.1f} to {last * 1e3:.1f} mm, strokes from {start * 1e3:.1f} to {end * 1e3:.1f} mm; "
        f"{straightness.noise}"
    )
    if straightness.directed:
        detail += f"; hysteresis of {straightness.hysteresis * 1e6:.2g} µm: a table for each direction"
    beyond = max(first - start, end - last)
    remedy = "Survey the whole stroke, or shorten stage.motion.stroke."
    noise = straightness.noise
    quiet = noise.point <= ROUNDING or 2.0 * noise.half_width <= found.encoder_floor
    if beyond <= 1e-6:
        remedy = "The noise leaves more than the encoder does: survey with more runs or more points."
    good = beyond <= 1e-6 and quiet
    yield judged("survey", good, detail, remedy, "fail" if beyond > stage.guide.runout else "warn")

    mark, described = straightness.survey.mark, stage.guide.reference
    if mark or described:
        remedy = "Align the survey, or home the machine to the reference that it was made with."
        wrong, agreed = straightness.mismatch(), f"x is counted from {mark!r}"
        if not mark:
            agreed = f"the machine's x is counted from {described!r}; the survey does not say from what its own is"
        elif not described:
            agreed += " in the survey; stage.guide.reference does not say from what the machine's is"
        yield judged("reference", not wrong, wrong or agreed, remedy, "fail")

    detail = (
        f"correction of {found.correction * 1e6:.1f} µm to each side; travel {stage.guide.travel * 1e6:g} µm, "
        f"stop at {stop * 1e6:g} µm"
    )
    if found.correction < found.encoder_floor:
        straight = found.correction < _STRAIGHT
        remedy = "Check the unit of the survey's deviation, and stage.encoder.y_resolution."
        few = (
            f"{found.correction * 1e6:.3g} µm to each side, but the encoder's count of "
            f"{stage.encoder.y_resolution * 1e6:g} µm leaves {found.encoder_floor * 1e6:.3g} µm p-p at best"
        )
        yield Finding("correction", "warn" if straight else "fail", few, remedy)
    else:
        yield Finding("correction", "ok", f"{found.correction / found.encoder_floor:.3g} times what the encoder leaves")
    narrowest = stage.actuator.air_gap * (1.0 - stage.uncertainty.air_gap)
    if stage.guide.travel >= stop:
        yield Finding("travel", "fail", detail, "stage.guide.travel must lie inside stage.platform.stop.")
    elif narrowest <= stop:
        detail += f", but the air gap may be {narrowest * 1e6:.0f} µm"
        yield Finding("travel", "warn", detail, "Measure the air gap and lower stage.uncertainty.air_gap.")
    else:
        yield Finding("travel", "ok", detail)


def _reference(
    controller: ControllerNodeParameters, straightness: StraightnessMap, found: Consequences, bandwidth: float
) -> Finding:
    """What tracking with ``bandwidth`` (Hz), and references from a while ago, lack of the stage's motion."""
    stage, lead = controller.stage, controller.reference_lead
    lacking, outdated = stage.lacking(straightness, bandwidth), stage.outdated(straightness, lead)
    rounding = stage.encoder.y_rounding
    detail = (
        f"ṙ up to {found.reference_speed * 1e6:.0f} µm/s, r̈ up to {found.reference_acceleration:.3g} m/s²; tracking "
        f"with {bandwidth:.0f} Hz lacks {lacking * 1e9:.1f} nm at a ramp's ends, a reference that is {lead * 1e3:g} ms "
        f"old {outdated * 1e9:.1f} nm; a count of y rounds by {rounding * 1e9:.1f} nm RMS"
    )
    remedy = "Raise feedforward.bandwidth (node feedforward), or accelerate the stage less."
    enough = stage.enough_lead(straightness, lead)
    if enough < lead:
        remedy = (
            f"Lower reference_lead (node controller) to {enough * 1e3:.2g} ms, as straightcomp design does; driver, "
            "feedforward and controller in one process (servo_node, demo --composed) have a reference after a sample."
        )
    # Tracking may take all of it.
    return judged("reference", enough == lead and lacking <= 1.01 * rounding, detail, remedy)


def _loop_findings(stage: StageParameters, control: ControlParameters, found: Consequences) -> Iterator[Finding]:
    if found.unstable_pole == 0.0:
        stiffness = f"{stage.platform.stiffness / 1e3:.3g} kN/m"
        yield Finding("instability", "ok", f"the flexure's {stiffness} outweigh the magnets' negative stiffness")
    else:
        yield _instability(stage, found)
    yield stiction(stage, control)
    margins, law = found.margins, control.law
    if law == OPEN_LOOP:
        yield Finding("loop", "ok", f"law {law} commands nothing but an excitation: there is no loop")
    elif margins is None:
        yield Finding("loop", "ok", f"law {law} switches at rest: it has no linear margins there")
    elif missing := missing_margin(control, stage):
        yield Finding("loop", "fail", missing, "The controller refuses these gains: design others.")
    else:
        where = ", without friction" if found.law_state == "free" else ""
        detail = (
            f"law {law}{where}: stable for gains from {margins.gain_low:.2f} to {margins.gain_high:.2f}, phase "
            f"{margins.phase:.0f}°, delay up to {margins.longest_delay * 1e3:.2f} ms"
        )
        if found.unstable_where:
            detail += f"; unstable within stage.uncertainty: {found.unstable_where}"
        wide = not found.unstable_where and margins.gain_low <= _GAIN_LOW and margins.gain_high >= _GAIN_HIGH
        remedy = "straightcomp design finds gains for this stage"
        if found.law_state == "free":
            # These gains follow from the dead time alone: no design changes them.
            remedy = "shorten the dead time (stage.rate, stage.drive.delay, stage.drive.bandwidth)"
        yield judged("loop", wide, detail, f"The margins are thin: {remedy}.")


def stiction(stage: StageParameters, control: ControlParameters) -> Finding:
    """Whether friction's bristles bend far enough to be seen, and what the law does where they do not."""
    friction, count = stage.friction, stage.encoder.y_resolution
    bending = friction.static / friction.bristle_stiffness
    detail = f"the bristles bend by {bending * 1e9:.3g} nm before the platform slides; a count is {count * 1e9:g} nm"
    if not needs_dither(stage):
        return Finding("stiction", "ok", detail if friction.static > 0.0 else "no dry friction")
    remedy = "Less static friction helps: lubricant, another pairing, less load. control.smc_observer.rest_band holds."
    dither = dither_of(control.smc_observer, stage).amplitude if control.law == "smc_observer" else 0.0
    if dither == 0.0:
        usual = f"control.smc_observer.dither {ObserverDesign().dither}"
        remedy = f"Law smc_observer with {usual} keeps the platform sliding. {remedy}"
        return Finding("stiction", "fail", f"{detail}: the platform will hunt", remedy)
    detail += f": a dither of {dither * 1e3:.3g} mA keeps it sliding in motion, at the price of work of the coils"
    largest = friction.static * stage.uncertainty.friction / friction.coulomb
    if largest <= _QUIET_STICTION:
        return Finding("stiction", "ok", detail)
    detail += f"; static friction may be {largest:.2g} times stage.friction.coulomb; allowed: {_QUIET_STICTION:g} times"
    remedy = f"Let straightcomp commission or friction find how much there is (stage.uncertainty.friction). {remedy}"
    return Finding("stiction", "warn", detail, remedy)


def _instability(stage: StageParameters, found: Consequences) -> Finding:
    detail = (
        f"the magnets' negative stiffness of {stage.actuator.position_stiffness / 1e3:.3g} kN/m gives a pole at "
        f"{found.unstable_pole:.0f} 1/s; dead time {stage.dead_time * 1e3:.2f} ms; product {found.difficulty:.2f}"
    )
    remedy = (
        f"Below {EASY:g} gains with usual margins exist: shorten the dead time to "
        f"{EASY / found.unstable_pole * 1e3:.2f} ms (rate, delay, amplifier), or lower stage.actuator.bias_current to "
        f"{stage.actuator.bias_current * (EASY / found.difficulty):.2g} A, or add mass."
    )
    bad: State = "fail" if found.difficulty >= FEASIBLE else "warn"
    return judged("instability", found.difficulty < EASY, detail, remedy, bad)


def _drive_findings(stage: StageParameters, found: Consequences) -> Iterator[Finding]:
    """Current, quantisation and load of the bus."""
    limit, drive, bias = stage.actuator.current_limit, stage.drive.current_range, stage.actuator.bias_current
    detail = (
        f"friction, pull and acceleration need up to {found.holding_current:.3g} A; limit {limit:g} A, "
        f"converter {drive:g} A, bias {bias:g} A"
    )
    usable = stage.highest_current
    if found.holding_current > usable:
        remedy = "Raise current limit, converter's range and bias, or reduce friction, mass or speed."
        yield Finding("force", "fail", detail, remedy)
    elif found.holding_current > _SHARE_OF_LIMIT * usable:
        remedy = "Little is left for the law's corrections: raise the current limit or the converter's range."
        yield Finding("force", "warn", detail, remedy)
    else:
        smaller = "the converter's range" if drive < bias else "the bias current, beyond which one magnet only pulls"
        remedy = f"stage.actuator.current_limit is above {smaller}."
        yield judged("force", limit <= min(drive, bias), detail, remedy)

    count = stage.encoder.y_resolution
    detail = (
        f"a count of {count * 1e9:g} nm leaves some {found.encoder_floor * 1e9:.0f} nm p-p at best; a step of the D/A "
        f"converter is {found.dac_force * 1e3:.3g} mN, or {found.dac_displacement * 1e9:.3g} nm "
        f"{'against the bristles' if stage.friction.static > 0.0 else 'within the dead time'}"
    )
    remedy = "The D/A converter is coarser than the encoder: use more bits, or a smaller range or gain."
    yield judged("quanta", found.dac_displacement <= count, detail, remedy)

    only_fd = ": only CAN FD carries it" if found.can_load > _BUS_FULL >= found.can_fd_load else ""
    detail = (
        f"at {stage.rate} Hz classic CAN (1 Mbit/s) is busy by {found.can_load:.0%}, CAN FD (5 Mbit/s) by "
        f"{found.can_fd_load:.0%}{only_fd}"
    )
    remedy = "No CAN bus carries this rate: use another link, or a lower rate."
    yield judged("bus", found.can_fd_load <= _BUS_FULL, detail, remedy)


def classic_bits(size: int, *, extended: bool = False) -> int:
    """Most bits of a classic frame with ``size`` bytes, with intermission (ISO 11898-1:2015).

    With an identifier of 11 bits there are 34 bits that are stuffed with the payload, at worst with one bit after every
    four, and 13 that are not. An identifier of 29 bits adds 20.
    """
    stuffable = 34 + 20 * extended + 8 * size
    return stuffable + (stuffable - 1) // 4 + 13


def fd_time(size: int, nominal: float, data: float, *, extended: bool = False) -> float:
    """Longest time in s of an FD frame with bit rate switch (ISO 11898-1:2015).

    Nominal rate: SOF, identifier of 11 bits, RRS, IDE, FDF, res and BRS, 17 bits and up to 4 stuff bits; an identifier
    of 29 bits adds 19; ACK, its delimiter, EOF and intermission, 12 bits. Data rate: ESI, DLC and payload, at worst
    with a stuff bit after every four; stuff count, CRC and their fixed stuff bits; the CRC delimiter.
    """
    arbitration, payload, crc = 17 + 19 * extended, 5 + 8 * size, 17 if size <= 16 else 21
    slow = arbitration + (arbitration - 1) // 4 + 12
    fixed_stuff = 1 + (4 + crc - 1) // 4
    return slow / nominal + (payload + (payload + 3) // 4 + 4 + crc + fixed_stuff + 1) / data


def frame_time(frames: Frames, nominal: float, data: float) -> float:
    """Longest time of one of these frames on an error-free bus in s, with the space to the next frame; bit rates in
    bit/s, ``data`` 0 on a classic bus."""
    extended = bool(frames.identifier & EXTENDED_ID)
    if frames.fd and data:
        return fd_time(frames.size, nominal, data, extended=extended)
    return classic_bits(frames.size, extended=extended) / nominal


def bus_load(wire: Wire, rate: float, nominal: float, data: float) -> dict[Frames, float]:
    """Fraction of the time that each kind of frame takes, at worst, while the servo runs at ``rate`` in Hz."""
    rates = {frames: rate / frames.every for frames in (*wire.commands, *wire.reports.values())}
    if wire.heartbeat:
        rates[wire.heartbeat] = 1.0 / wire.heartbeat.period
    return {frames: frame_time(frames, nominal, data) * sent for frames, sent in rates.items()}


def board_findings(driver: DriverNodeParameters) -> Iterator[Finding]:
    """Check the frames of a machine that is a board on CAN or has a DBC file, none of another: ranges, resolution,
    protection, load of the bus."""
    stage, can = driver.stage, driver.can
    if driver.hardware != "can" and not can.dbc:
        return
    wire, encoder, step = can.make_wire(), stage.encoder, stage.drive.current_step
    names = [frames.name for frames in (*wire.reports.values(), *wire.commands)]
    yield Finding("wire", "ok", f"{wire.dbc.file}: {', '.join(names)}")
    yield _x_finding(wire, stage)
    stop, limit = stage.platform.stop, stage.actuator.current_limit
    yield _range("wire y", wire.homes["y"], "y", (-stop, stop), encoder.y_resolution, "m")
    yield _range("wire command", wire.command, "current", (-limit, limit), step, "A")
    if wire.current is not None:
        yield _range("wire current", wire.current, "current", (-limit, limit), step, "A")
    missing = gaps(wire)
    for gap in missing:
        yield Finding("wire protection", "warn", gap, "Ask the maker of the board, or accept what follows.")
    if not missing:
        yield Finding("wire protection", "ok", "CRC, counters, echo and heartbeat are there")
    state, beat = wire.intervals(stage.rate)
    in_time = beat < can.heartbeat_timeout and state < min(can.silences(stage.rate)[1], can.answer_timeout)
    detail = f"the state of the amplifier comes every {state * 1e3:g} ms"
    detail += f", the heartbeat every {beat * 1e3:g} ms" if beat else ""
    remedy = (
        "Let the board send them more often, or raise can.heartbeat_timeout and, for the state, can.answer_timeout."
    )
    yield judged("wire state", in_time, detail, remedy, "fail")
    busy = sum(bus_load(wire, stage.rate, can.bitrate, can.data_bitrate if can.fd else 0.0).values())
    detail = f"at {stage.rate} Hz the bus of {can.bitrate / 1e6:g} Mbit/s is busy by {busy:.0%}"
    remedy = "Shorten the frames, raise can.bitrate or can.data_bitrate, or lower stage.rate."
    yield judged("wire bus", busy <= _BUS_FULL, detail, remedy, "fail" if busy > 1.0 else "warn")


def _x_finding(wire: Wire, stage: StageParameters) -> Finding:
    """Range and resolution of x, and whether the driver can follow it from one sample to the next."""
    name, ends, encoder = "wire x", reach(stage.motion), stage.encoder
    step, turn = wire.sample.step("x"), wire.sample.x_modulus
    travel = ends[1] - ends[0] + 2.0 * stage.guide.runout
    repeated, way = 0.0 < turn <= travel, stage.motion.highest_speed / stage.rate
    moved = f"the stage may move by {way:.3g} m within a sample"
    if repeated and turn <= 2.0 * (way + wire.noise("x", encoder.x_resolution)):
        remedy = "Use a counter of more bits, or check its unit in the DBC file."
        return Finding(name, "fail", f"x repeats itself every {turn:.6g} m, and {moved}", remedy)
    if repeated and "referenced" not in wire.homes:
        detail = f"x repeats itself every {turn:.6g} m of a travel of {travel:.6g} m, and no signal says 'referenced'"
        return Finding(name, "fail", detail, "Name a signal in can.wire.referenced, or use a counter of more bits.")
    # Readings differ by whole steps.
    change = step * math.ceil(stage.motion.speed / stage.rate / step) if step else 0.0
    if change > way + encoder.x_noise:
        changes = f"steps of {step:.3g} m, up to {change:.3g} m at once"
        detail = f"x comes in {changes}, which the driver takes for jumps: {moved}"
        remedy = "Use a finer scale, check its unit in the DBC file, or set stage.encoder.x_resolution to this step."
        return Finding(name, "fail", detail, remedy)
    return _range(name, wire.sample, "x", ends, encoder.x_resolution, "m")


_WRONG_UNIT = 100.0
"""Steps of a signal in one of the stage, from which its unit is wrong: units are a factor of 1000 apart."""


def _range(name: str, frames: Frames, field: str, ends: tuple[float, float], resolution: float, unit: str) -> Finding:
    (least, largest), step = frames.spans[field], frames.step(field)
    coded, signal = frames.fields[field], frames.fields[field].name
    if coded.is_float:
        # Its resolution where the stage needs the largest number.
        scale = abs(coded.scale * frames.factors[field])
        kind: Any = {32: np.float32, 64: np.float64}[coded.length]
        step = float(np.spacing(kind(max(abs(end) for end in ends) / scale))) * scale
    detail = (
        f"'{signal}' from {least:.6g} to {largest:.6g} {unit} in steps of {step:.3g} {unit}; the stage needs "
        f"{ends[0]:.6g} to {ends[1]:.6g} {unit} in steps of {resolution:.3g} {unit}"
    )
    wraps = frames.wraps and field == "x"
    if not wraps and (least > ends[0] or largest < ends[1]):
        remedy = f"Use a wider signal or another scale for '{signal}', or check the stage and the unit in the DBC file."
        return Finding(name, "fail", detail, remedy)
    remedy = f"The scale of '{signal}' is too coarse: use a finer one, or more bits."
    # A DBC file writes its scales with few digits.
    wrong = step > _WRONG_UNIT * resolution
    remedy += " Is the unit in the DBC file right?" if wrong else ""
    return judged(name, step <= 1.001 * resolution, detail, remedy, "fail" if wrong else "warn")
