"""Steps with the loop closed, from the first safe law to the measured margins of the designed one.

- `safe_loop`: a law for the stated uncertainty, with which the loop is closed for the first time.
- `identification`: the machine from one cycle along an excitation, and whether it is the one that was described. The
  mass is held at its description, since position and current identify forces only up to a common factor, which no law
  needs. What is compared with the description is what does not depend on that factor. Then, still under the safe law,
  the frequency response shows the resonances: a mode that is not described must not meet a law that excites it.
- `design`: gains of `smc_observer` for the machine as identified, with its modes, and what of it is still open.
- `frequency_response`: plant and margins as measured; does what was identified explain them? The same measurement is
  made of the simulated machine as identified. Between rest and sliding, friction is neither a spring nor a damping:
  what it makes of the response depends on the excitation, and no closed form has it.
"""

import dataclasses
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.analysis.current_path import SHORTEST, SWITCH_ON
from straightcomp_ros.analysis.error_detail import sustained_oscillation
from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.control.excitation import (
    ExcitationEnded,
    FrequencyResponseError,
    MultisineParameters,
    suited_multisine,
)
from straightcomp_ros.model.motion import forward_and_back
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.declaration import to_mapping
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.tuning.commissioning import LOOP, LeftTravel
from straightcomp_ros.tuning.commissioning.machine import Array, Outcome, Work, recorded_reading
from straightcomp_ros.tuning.commissioning.open_loop import TOLERANCE, fastest_shown
from straightcomp_ros.tuning.design.automatic_design import design_gains
from straightcomp_ros.tuning.design.feasible_gains import LAW as SAFE_LAW
from straightcomp_ros.tuning.design.feasible_gains import DesignError, safe_law
from straightcomp_ros.tuning.frequency_response.found_modes import FoundPlant, Interval
from straightcomp_ros.tuning.frequency_response.measured_response import (
    WITHIN_DB,
    WITHIN_DEG,
    ComparedResponse,
    ResponseMargins,
    measure_simulated,
)
from straightcomp_ros.tuning.identification.estimate import DERIVED, POOR, Estimate, estimate_from_bag, excitation

LAW = "smc_observer"
LEAST_PHASE, LEAST_GAIN = 10.0, 1.3
"""Smallest phase margin in degrees and gain margin that `frequency_response` accepts."""
_KNOWN, _FILTERS = "platform.mass", "control.filters."
_LENGTH = 0.5
"""m; of the excitation's stroke, at most."""
STAYS_OPEN = {"mass": 0.02, "force": 0.05, "air_gap": 0.02, "friction": 1.3, "amplifier": 1.05}
"""Uncertainty that stays, however narrow an interval is: a model is not the machine."""
DELAY_STAYS = 0.1
_FORCES = tuple(f"friction.{name}" for name in ("coulomb", "static", "bristle_stiffness", "bristle_damping", "viscous"))
_BEFORE = 0.25
"""s in which an oscillation is looked for when the platform leaves its travel."""
_SWUNG = 0.0015
"""Least amplitude of it relative to the way: one of 93 Hz that grows with 100 1/s has 0.0024, a smooth way 0.0004."""
_RINGING = {"damping": 0.01, "damping_factor": 3.0, "frequency_error": 0.05, "participation_error": 0.5}
"""Of a mode that made the platform swing, as far as is known before it has been measured: a loop at the limit of its
stability swings near the mode (at 91 Hz with one of 94 Hz)."""
_SEEN = (0.4, 0.28, 0.2, 0.14)
"""Its participation at coil and encoder, apart: the first with which there is a safe law is taken."""
_SEARCH = {"lines": 200, "period": 4.0, "draws": 4}
"""Of the excitation that looks for modes. 40 lines take two modes within 15 % for one; a mode of 0.5 % rings on for a
second under the safe law, which knows nothing of it, so that few long draws say more than many short ones."""
_IN_SIMULATION = 0.7
"""Share of the travel that the excitation may need in the simulation."""
_MOTIONS = (1.0, 0.7, 0.5, 0.35)
"""Parts of the usual motion, tried in this order. With 0.7 times the motion a machine needed 0.4 times the travel."""


def safe_loop(work: Work) -> Outcome:
    """Find the law; nothing moves yet."""
    try:
        found = safe_law(make_scenario(work.described(), [SAFE_LAW]), progress=work.progress)
    except DesignError as error:
        return Outcome(False, str(error))
    return Outcome(
        True,
        f"'{SAFE_LAW}' holds at all {found.corners} corners of the uncertainty; the slowest mode decays with "
        f"{found.decay:.3g} 1/s",
        {
            "decay_1_s": found.decay,
            "worst_corner": found.worst,
            "simulated_excursion_um": found.excursion * 1e6,
            "simulated_pp_um": found.pp * 1e6,
        },
        gains={"control.law": SAFE_LAW, **found.values},
    )


def identification(work: Work) -> Outcome:
    """Make a cycle along the excitation under the present law, several if it is short, and identify."""
    stage, bag = work.stage, work.folder / "bags" / "identification"
    try:
        gains = _excited(work, bag)
        work.progress(0.1)
        found = estimate_from_bag(bag, stage, [_KNOWN], lambda fraction: work.progress(0.1 + 0.9 * fraction))
    except (LeftTravel, IdentificationError) as error:
        return Outcome(False, str(error))
    figures = {
        **found.to_display(),
        "prediction_error_nm": found.fit.rms_error_m * 1e9,
        "amplifier_bandwidth_Hz": found.path.rate / (2.0 * math.pi),
        "parameters": {
            name: {"value": one.value, "low": one.low, "high": one.high, "known": one.known, "poor": one.poor}
            for name, one in found.parameters.items()
        },
    }
    by_record = facts = facts_found(found, stage)
    force, scale, mechanics, words = 1.0, 1.0, FoundPlant(), ""
    # The second look has the machine of the first one for its model, and sees more.
    for _ in range(2):
        seen, said, other = _looked_at(work.given("controller", gains), facts)
        gains |= other
        if seen == FoundPlant():
            words = words or said
            break
        mechanics, words = seen, said
        # Relative to the facts that it was looked at with: those of the record until a look shows the force.
        if mechanics.gain.high / mechanics.gain.value <= POOR:
            gain = Interval(*(force * one for one in mechanics.gain))
            force = gain.value
            facts, scale = scaled_by(gain, by_record, found, stage)
    if strange := strangeness(found, work.description, scale):
        return Outcome(False, strange, figures)
    modes = modes_found(mechanics, stage)
    words += ", which the design answers as it was found" if modes else ""
    return Outcome(
        True,
        f"the model predicts each sample within {with_digits(found.fit.rms_error_m * 1e9, 0)} nm RMS"
        f"{f'; {found.centre}' if found.centre else ''}{words}; facts that stay open, named in the "
        f"certificate: {len(found.not_identifiable)}",
        figures,
        stage={**facts, **modes},
        gains=gains,
    )


def _excited(work: Work, bag: Path) -> dict[str, Any]:
    """Make as many cycles along the excitation as an identification needs, recorded as ``bag``; returns the gains that
    the safe law got for it.

    A platform that swings out of its travel rings at a mode that no description has: they are made once more, under a
    safe law for a mode there.

    Raises:
        LeftTravel: the platform left its travel, and there is no such law, or under it too.
    """
    # Next to the bag: in the folder itself may be a file of the user's own, the survey even.
    stage, file = work.stage, bag.with_name("excitation.csv")
    file.parent.mkdir(parents=True, exist_ok=True)
    survey, facts = excitation(stage, _LENGTH)
    write_survey(file, survey, ("Made up: excites the platform.",))
    values = with_values(work.values, "stage", {"guide.file": str(file), **facts})
    cycle_ns = forward_and_back(node_parameters("driver", values).stage.motion)[-1].time_ns
    count = math.ceil((SHORTEST + SWITCH_ON) * stage.period_ns / cycle_ns)
    try:
        work.machine.stroke(values, bag, work.travel, count)
        return {}
    except LeftTravel as error:
        safe, left = _leaving_alone(work, _swinging(recorded_reading(bag), stage), error)
    try:
        work.machine.stroke(with_values(values, "controller", safe), bag, work.travel, count)
    except LeftTravel as error:
        again = "and left it again under a law for a mode there: describe it (stage.platform.modes)"
        raise LeftTravel(f"{left}, {again}") from error
    return safe


def _leaving_alone(work: Work, f: float, left: ValueError) -> tuple[dict[str, Any], str]:
    """Gains of a safe law for a mode at ``f`` Hz, where the platform swung, and what happened in words.

    Raises:
        ValueError: ``left``, where it did not swing: ``f`` is 0.
        LeftTravel: there is no such law.
    """
    free = _undescribed(work.stage)
    if not f or not free:
        raise left
    said = f"{left}; it swung at {f:.0f} Hz then"
    for seen in _SEEN:
        mode = {"frequency": f, "coil": seen, "encoder": -seen, **_RINGING}
        facts = {f"platform.modes.{free[0]}.{fact}": value for fact, value in mode.items()}
        with suppress(DesignError):
            scenario = make_scenario(with_values(work.described(), "stage", facts), [SAFE_LAW])
            return dict(safe_law(scenario).values), said
    raise LeftTravel(f"{said}; no safe law can leave a mode there alone: describe it (stage.platform.modes)")


def _swinging(y: Array, stage: StageParameters) -> float:
    """Frequency in Hz at which the platform swung at the end of ``y`` (n,) in m; 0 if it did not."""
    samples = round(_BEFORE * stage.rate)
    y = y[-samples:]
    if not y.size:
        return 0.0
    y = np.pad(y, (samples - y.size, 0), mode="edge")
    line = sustained_oscillation(y, np.zeros_like(y), stage.period)
    return line.frequency if line.amplitude >= _SWUNG * float(np.ptp(y)) else 0.0


def _looked_at(before: Work, facts: Mapping[str, Any]) -> tuple[FoundPlant, str, dict[str, Any]]:
    """Gain relative to a description with ``facts`` and modes of the machine by its response, its modes in words, and
    the gains of another safe law if it took one; nothing where it cannot be measured."""
    work = before.given("stage", facts)
    gains, scale = dict[str, Any](), 1.0
    try:
        found, left, swing = _response_or_swing(work)
        if found is None:
            # With a force over mass that a mode has put into the record, the safe law may be none.
            found, _, _ = _response_or_swing(before)
            scale = before.stage.actuator.current_stiffness / work.stage.actuator.current_stiffness
        if found is None:
            gains, _ = _leaving_alone(work, swing, left)
            work = work.given("controller", gains)
            (found, left, _), scale = _response_or_swing(work), 1.0
        if found is None:
            raise left
    except (FrequencyResponseError, LeftTravel) as error:
        return FoundPlant(), f"; resonances were not looked for: {error}", {}
    gain, modes = found.mechanics
    words = "".join(f"; {mode.text}" for mode in modes)
    return FoundPlant(Interval(*(scale * one for one in gain)), modes), words, gains


def _response_or_swing(work: Work) -> tuple[ComparedResponse | None, ValueError, float]:
    """The response in search of modes; none of a platform that swings, with what it did and at which frequency in Hz,
    0 if that is not seen."""
    left: ValueError = FrequencyResponseError("the platform swings by itself")
    try:
        found = _measured(work, **_SEARCH)
    except ExcitationEnded as error:
        return None, error, _swinging(error.reading, work.stage)
    return None if found.measured.swing else found, left, found.measured.swing


def modes_found(mechanics: FoundPlant, stage: StageParameters) -> dict[str, float]:
    """Facts of the modes that the description lacks, by dotted name."""
    unknown = [mode for mode in mechanics.modes if not mode.described]
    found = zip(_undescribed(stage), unknown, strict=False)
    return {fact: x for name, mode in found for fact, x in mode.facts(name).items()}


def _undescribed(stage: StageParameters) -> list[str]:
    """Names of the modes that the description has room for."""
    return [name for name in ("first", "second") if not getattr(stage.platform.modes, name).frequency]


def scaled_by(
    gain: Interval, facts: Mapping[str, Any], found: Estimate, stage: StageParameters
) -> tuple[dict[str, Any], float]:
    """``facts`` with all forces over the mass as the response shows them, and that scale relative to the record's.

    What rings or gives way in a record is inertia to a model without it: all forces come out too large or too small by
    one factor. The response has the mass's line apart from the modes.
    """
    turns = facts.get("actuator.turns", stage.actuator.turns)
    gap = facts.get("actuator.air_gap", stage.actuator.air_gap)
    # A gap that the record hardly shows is not among the facts: the response has it in the force.
    own_gap, own_turns = (found.parameters[f"actuator.{name}"].value for name in ("air_gap", "turns"))
    scale = gain.value * (turns / own_turns * own_gap / gap) ** 2
    ranges = stage.uncertainty
    scaled = {name: x * scale for name, x in facts.items() if name in _FORCES}
    return {
        **facts,
        **scaled,
        "actuator.turns": turns * math.sqrt(gain.value),
        "uncertainty.mass": min(ranges.mass, STAYS_OPEN["mass"]),
        "uncertainty.force": min(ranges.force, max(STAYS_OPEN["force"], gain.high / gain.value - 1.0)),
    }, scale


def strangeness(found: Estimate, described: StageParameters, scale: float = 1.0) -> str:
    """What is certainly not as described, in a sentence, empty if nothing is; ``scale`` is that of :func:`scaled_by`.

    Of what the record does not show well enough for that, the response is judged (`frequency_response`).
    """
    ranges = described.uncertainty
    values = to_mapping(described)

    def relative(name: str, factor: float = 1.0, power: float = 1.0) -> Interval:
        one, before = found.parameters[name], values[name]
        if not before > 0.0:
            return Interval(1.0, 1.0, 1.0)
        return Interval(*(factor * (x / before) ** power for x in (one.value, one.low, one.high)))

    heaviest, lightest = (1.0 + ranges.mass) * TOLERANCE, (1.0 - ranges.mass) / TOLERANCE
    checks = (
        (
            relative("actuator.air_gap"),
            (1.0 - ranges.air_gap) / TOLERANCE,
            (1.0 + ranges.air_gap) * TOLERANCE,
            "the air gap seems {:.2g} times the described one (allowed by 'stage.uncertainty.air_gap': {:.2g} to "
            "{:.2g}); look at the count of the encoder of y, which a wrong gap looks like, and at the gap",
        ),
        (
            # K̄_i/M = N² A …/y0² M: with the gap as found, what is left is force over mass.
            relative("actuator.turns", scale, 2.0),
            (1.0 - ranges.force) / heaviest,
            (1.0 + ranges.force) / lightest,
            "a current accelerates the platform {:.2g} times as much as described (allowed by 'stage.uncertainty': "
            "{:.2g} to {:.2g}); look whether the platform is loose, or has lost a part of its load, and at the coils",
        ),
        (
            relative("friction.coulomb", scale),
            1.0 / (ranges.friction * heaviest),
            ranges.friction / lightest,
            "friction is {:.2g} times the described one relative to the mass (allowed by 'stage.uncertainty': {:.2g} "
            "to {:.2g}); look at the bearing, or describe the friction that the platform has ('stage.friction')",
        ),
    )
    # One may look like another: much friction makes the gap seem wide.
    strange = [one for one in checks if one[0].high < one[1] or one[0].low > one[2]]
    return "; ".join(text.format(seen.value, low, high) for seen, low, high, text in strange)


def facts_found(found: Estimate, stage: StageParameters) -> dict[str, Any]:
    """Facts of the description as found, by dotted name, and how well they are known now: never worse than before.

    What has a range keeps its description where that is narrower than what the record leaves open, and other facts
    keep it where the record hardly identifies them.
    """
    estimated, before = found.parameters, stage.uncertainty
    turns, gap, friction = (estimated[name] for name in ("actuator.turns", "actuator.air_gap", "friction.coulomb"))
    # The mass is held, so that the forces have its uncertainty too: without them it is as open as it was.
    intervals = {
        "mass": (turns, 0.0),
        "force": (turns, (turns.high / turns.value) ** 2 - 1.0),
        "air_gap": (gap, gap.high / gap.value - 1.0),
        "friction": (friction, friction.high / friction.value if friction.value > 0.0 else 0.0),
    }
    better = {fact.name for name, (fact, width) in intervals.items() if 0.0 < width < getattr(before, name)}
    if gap.name not in better:
        # The record has its turns at its own gap: at another one they are another force.
        better.discard(turns.name)
    facts: dict[str, Any] = {
        name: one.value
        for name, one in estimated.items()
        if name not in DERIVED and not one.known and (name in better if one in (turns, gap, friction) else not one.poor)
    }
    # Friction that differs from its description differs as a whole: F_S/F_C is described better than F_S.
    described, coulomb = stage.friction, facts.get("friction.coulomb", stage.friction.coulomb)
    ratio = described.static / described.coulomb if described.coulomb > 0.0 else 1.0
    if {"friction.coulomb", "friction.static"} & facts.keys():
        facts["friction.static"] = max(facts.get("friction.static", ratio * coulomb), coulomb)
    for name, (fact, width) in intervals.items():
        if fact.name in facts:
            facts[f"uncertainty.{name}"] = min(getattr(before, name), max(STAYS_OPEN[name], width))
    if stage.drive.bandwidth >= fastest_shown(stage.period):
        # Amplifier and delay are as open as they were described.
        return facts
    if found.path.rate_found:
        delay = max(found.path.delay * stage.rate, 0.0)
        facts |= {"drive.bandwidth": found.path.rate / (2.0 * math.pi), "drive.delay": delay}
    return {
        **facts,
        "uncertainty.amplifier": min(before.amplifier, STAYS_OPEN["amplifier"]),
        "uncertainty.shortest_delay": 1.0 - DELAY_STAYS,
        "uncertainty.longest_delay": 1.0 + DELAY_STAYS,
    }


def design(work: Work) -> Outcome:
    """Search the gains; nothing moves."""
    # The notches of the laws before are not the design's.
    before = [name for outcome in work.outcomes.values() for name in outcome.gains]
    unset = {name: 0.0 for name in before if name.startswith(_FILTERS) and name.endswith("frequency")}
    scenario = make_scenario(with_values(work.described(), "controller", unset), [LAW])
    try:
        found = design_gains(
            scenario,
            LAW,
            evaluations=work.evaluations,
            machines=work.machines,
            progress=lambda part, fraction: work.progress(fraction if part == "search" else 0.0),
        )
    except DesignError as error:
        return Outcome(False, str(error))
    pp, step = found.figures.pp.median * 1e6, found.figures.work.median * 1e3
    figures = {
        "predicted_pp_um": pp,
        "predicted_rms_um": found.figures.rms.median * 1e6,
        "predicted_step_mA": step,
        "uncertain_machines": found.verification.to_display(),
        **found.limits_to_display(),
    }
    if not found.holds:
        verdict = found.verification.verdict
        return Outcome(False, f"the designed law is not in order on all machines that are left: {verdict}", figures)
    sentence = f"{with_digits(pp, 3)} µm p-p predicted, at {with_digits(step, 2)} mA from sample to sample"
    sentence = "; ".join([sentence, *found.warnings])
    return Outcome(True, sentence, figures, gains={"control.law": LAW, **unset, **found.values, **found.newer})


def frequency_response(work: Work) -> Outcome:
    """Measure under the designed law, with the stage at rest; where that shows a mode which the safe law did not,
    under one that is designed for this mode too."""
    modes, designed, words = dict[str, float](), Outcome(True, ""), ""
    try:
        found = _measured(work)
        if modes := modes_found(found.mechanics, work.stage):
            words = "; ".join(mode.text for mode in found.mechanics.modes if not mode.described)
            work = work.given("stage", modes)
            designed = design(work)
            if not designed.passed:
                return Outcome(False, f"{words}; {designed.sentence}")
            work = work.given("controller", designed.gains)
            found = _measured(work)
            words = f"; {words}, designed for: {designed.sentence}"
    except FrequencyResponseError as error:
        return Outcome(False, str(error))
    stage = work.stage
    # Only here: matplotlib takes longer to import than the measurement.
    from straightcomp_ros.tuning.frequency_response.response_plot import plot_response

    plot_response(found, work.folder / LOOP, f"Stage '{stage.name}' under law '{found.law}'")
    measured, lines = found.measured, found.measured.coherent
    margins, of_model = found.margins
    gain, phase = found.largest_deviations
    figures = {
        "margins": margins._asdict(),
        "model_margins": of_model._asdict(),
        "coherent_lines": int(lines.sum()),
        "lines": int(lines.size),
        "largest_deviation_dB": gain,
        "largest_deviation_deg": phase,
        "frequency_Hz": measured.frequencies.tolist(),
        "coherence": measured.coherence.tolist(),
        "plant_um_A": (np.abs(measured.response.plant) * 1e6).tolist(),
        "model_plant_um_A": (np.abs(found.model.plant) * 1e6).tolist(),
    }
    figures["modes"] = [mode.to_display() for mode in found.mechanics.modes]
    if modes:
        figures["design"] = designed.figures
    wrong = margins_missed(margins)
    if unknown := [mode for mode in found.mechanics.modes if not mode.described]:
        facts = ", ".join(f"stage.{name}: {value:.4g}" for name, value in unknown[0].facts("first").items())
        wrong = f"{unknown[0].text}; describe it ({facts}), so that the design answers it, and commission again"
    elif not found.explained and not dataclasses.replace(found, open=found.open + _open_by_friction(work)).explained:
        lateness = f"; {found.lateness}" if found.lateness else ""
        wrong = (
            f"what was identified does not explain the measured plant: up to {gain:.2g} dB and {phase:.2g}° off "
            f"(allowed: {WITHIN_DB:g} dB, {WITHIN_DEG:g}°); look whether the machine has changed since{lateness}"
        )
    if wrong:
        return Outcome(False, wrong, figures)
    within = f"the model explains the plant within {gain:.2f} dB and {phase:.1f}°"
    sentence = f"{within}; {_in_words(margins)}, peak of |S| {margins.sensitivity_peak:.2f}{words}"
    return Outcome(True, sentence, figures, stage=modes, gains=designed.gains)


def margins_missed(margins: ResponseMargins) -> str:
    """What the margins lack, in a sentence; empty if nothing.

    A gain margin beyond the lines is larger than any that is demanded. The gain crossover must be among them: every law
    that holds this unstable plant has one.
    """
    if margins.phase_deg is None:
        return (
            "no gain crossover is among the coherent lines, so that the phase margin is unknown; look for noise on y, "
            "and for more friction than was identified"
        )
    low, high = margins.gain_low or 0.0, margins.gain_high or np.inf
    if margins.phase_deg >= LEAST_PHASE and high >= LEAST_GAIN and low <= 1.0 / LEAST_GAIN:
        return ""
    return (
        f"the measured margins are too small: {_in_words(margins)} (allowed: phase >= {LEAST_PHASE:g}°, gain down to "
        f"{1.0 / LEAST_GAIN:.2g} and up to {LEAST_GAIN:g} times)"
    )


def _in_words(margins: ResponseMargins) -> str:
    ends = (("down to", margins.gain_low), ("up to", margins.gain_high))
    known = " and ".join(f"{words} {gain:.2f}" for words, gain in ends if gain is not None)
    return f"phase margin {margins.phase_deg:.0f}°, gain {f'{known} times' if known else 'beyond the lines'}"


def _measured(work: Work, **excited: Any) -> ComparedResponse:
    """The response; once more with half the motion if the platform left the travel, which late commands may cause."""
    excitation, described = _foreseen(work, suited_multisine(work.stage, **excited))
    try:
        found = work.machine.response(work.values, excitation)
    except ExcitationEnded:
        excitation, described = _foreseen(work, dataclasses.replace(excitation, motion=0.5 * excitation.motion))
        found = work.machine.response(work.values, excitation)
    own, foreseen = found.mechanics, described.mechanics
    # What the simulated machine shows as well is friction.
    modes = tuple(
        one
        for one in own.modes
        if one.described or not any(one.frequency.meets(other.frequency) for other in foreseen.modes)
    )
    mechanics = FoundPlant(own.gain.over(foreseen.gain), modes)
    return dataclasses.replace(found, model=described.measured.response, mechanics=mechanics)


def _foreseen(work: Work, excitation: MultisineParameters) -> tuple[MultisineParameters, ComparedResponse]:
    """The excitation, with less motion where the machine as identified needs too much of the travel; its response.

    No closed form has the peaks: where the current reaches its limit, the magnets carry the platform on.
    """
    reason = ""
    for share in _MOTIONS:
        tried = dataclasses.replace(excitation, motion=share * excitation.motion)
        # The same currents within less travel.
        within = dataclasses.replace(tried, travel=_IN_SIMULATION * tried.travel, motion=tried.motion / _IN_SIMULATION)
        try:
            return tried, measure_simulated(work.described(), within)
        except ExcitationEnded as error:
            reason = str(error)
    raise FrequencyResponseError(f"the machine as identified needs too much of the travel: {reason}")


def _open_by_friction(work: Work) -> Array:
    """(lines,) The share of the plant by which it may differ where friction is not known better than it was described:
    a record whose platform hardly slides does not show how much there is."""
    excitation, described = _foreseen(work, suited_multisine(work.stage))
    ranges, plants = work.stage.uncertainty, described.measured.response.plant
    total = np.zeros(plants.size)
    for friction in (1.0 / ranges.friction, ranges.friction):
        values = with_values(work.described(), "driver", {"simulated.truth.friction": friction})
        with suppress(ExcitationEnded):
            end = measure_simulated(values, excitation).measured.response.plant
            total = np.maximum(total, np.abs(end / plants - 1.0))
    return total
