"""Step `identification`: the machine from one cycle along an excitation, and whether it is the one that was described.

The mass is held at its description, since position and current tell forces only up to a common factor, which no law
needs. What is compared with the description is what does not depend on that factor.
"""

import math
from typing import Any

from straightcomp_ros.analysis import IdentificationError
from straightcomp_ros.stage.description import StageParameters, UncertaintyParameters
from straightcomp_ros.straightness.survey import write_survey
from straightcomp_ros.tuning.commissioning import LeftTravel
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work
from straightcomp_ros.tuning.identification.estimate import DERIVED, Estimate, estimate_from_bag
from straightcomp_ros.tuning.identification.excitation import excitation_survey
from straightcomp_ros.tuning.identification.untold import untold

_KNOWN = "platform.mass"
_LENGTH = 0.5
"""m; of the excitation's stroke, at most."""
_TOLERANCE = 1.1
"""Factor beyond its range at which a fact is called wrong."""
_STAYS_OPEN = {"mass": 0.02, "force": 0.05, "air_gap": 0.02, "friction": 1.3, "amplifier": 1.05}
"""Uncertainty that stays, however narrow an interval is: a model is not the machine."""
_DELAY_STAYS = 0.1


def identification(work: Work) -> Outcome:
    """Make one cycle along the excitation under the present law, and identify."""
    stage = work.stage
    excitation, length = work.folder / "excitation.csv", min(_LENGTH, stage.motion.stroke)
    write_survey(excitation, excitation_survey(length, stage.motion.start), ("Made up: excites the platform.",))
    changed = {"guide.file": str(excitation), "motion.stroke": length}
    values = {**work.values, "stage": {**work.values.get("stage", {}), **changed}}
    bag = work.folder / "bags" / "identification"
    try:
        work.machine.stroke(values, bag, work.travel)
        work.progress(0.1)
        found = estimate_from_bag(bag, stage, [_KNOWN], lambda fraction: work.progress(0.1 + 0.9 * fraction))
    except (LeftTravel, IdentificationError) as error:
        return Outcome(False, str(error))
    figures = _figures(found)
    strange = strangeness(found, work.description)
    if strange:
        return Outcome(False, strange, figures)
    return Outcome(
        True,
        f"the model predicts each sample within {found.fit.rms_error_m * 1e9:.0f} nm RMS"
        f"{f'; {found.centre}' if found.centre else ''}; what it cannot tell: {' '.join(untold(found))}",
        figures,
        stage=facts_found(found, stage),
    )


def _figures(found: Estimate) -> dict[str, Any]:
    parameters = {
        name: {"value": one.value, "low": one.low, "high": one.high, "known": one.known, "poor": one.poor}
        for name, one in found.parameters.items()
    }
    return {
        "prediction_error_nm": found.fit.rms_error_m * 1e9,
        "amplifier_bandwidth_Hz": found.path.rate / (2.0 * math.pi),
        "amplifier_bandwidth_deviation_Hz": found.path.rate_deviation / (2.0 * math.pi),
        "delay_us": found.path.delay * 1e6,
        "delay_spread_us": [delay * 1e6 for delay in found.path.delay_spread],
        "centre_um": found.centre.to_display() if found.centre else None,
        "parameters": parameters,
        "untold": untold(found),
    }


def strangeness(found: Estimate, described: StageParameters) -> str:
    """What is not as described, in a sentence; empty if all is."""
    ranges, actuator = described.uncertainty, described.actuator
    value = {name: one.value for name, one in found.parameters.items()}
    gap = value["actuator.air_gap"] / actuator.air_gap
    # K̄_i/M = N² A …/y0² M: with the gap as found, what is left is force over mass.
    force = (value["actuator.turns"] / actuator.turns) ** 2
    friction = value["friction.coulomb"] / described.friction.coulomb
    heaviest = (1.0 + ranges.mass) * _TOLERANCE
    lightest = (1.0 - ranges.mass) / _TOLERANCE
    checks = (
        (
            gap,
            (1.0 - ranges.air_gap) / _TOLERANCE,
            (1.0 + ranges.air_gap) * _TOLERANCE,
            "the air gap seems {:.2g} times the described one (allowed by 'stage.uncertainty.air_gap': {:.2g} to "
            "{:.2g}); look at the count of the encoder of y, which a wrong gap looks like, and at the gap",
        ),
        (
            force,
            (1.0 - ranges.force) / heaviest,
            (1.0 + ranges.force) / lightest,
            "a current accelerates the platform {:.2g} times as much as described (allowed by 'stage.uncertainty': "
            "{:.2g} to {:.2g}); look whether the platform is loose, or has lost a part of its load, and at the coils",
        ),
        (
            friction,
            1.0 / (ranges.friction * heaviest),
            ranges.friction / lightest,
            "friction is {:.2g} times the described one relative to the mass (allowed by 'stage.uncertainty': {:.2g} "
            "to {:.2g}); look at the bearing, or describe the friction that the platform has ('stage.friction')",
        ),
    )
    return next((text.format(*numbers) for *numbers, text in checks if not numbers[1] <= numbers[0] <= numbers[2]), "")


def facts_found(found: Estimate, stage: StageParameters) -> dict[str, Any]:
    """Facts of the description as found, by dotted name, and how well they are known now."""
    estimated = found.parameters
    # What the record hardly tells keeps its description.
    facts: dict[str, Any] = {
        name: one.value for name, one in estimated.items() if name not in DERIVED and not (one.known or one.poor)
    }
    # Friction that differs from its description differs as a whole: F_S/F_C is described better than F_S.
    described, coulomb = stage.friction, facts.get("friction.coulomb", stage.friction.coulomb)
    static = facts.get("friction.static", described.static / described.coulomb * coulomb)
    facts["friction.static"] = max(static, coulomb)
    if found.path.rate_found:
        facts |= {"drive.bandwidth": found.path.rate / (2.0 * math.pi), "drive.delay": found.path.delay * stage.rate}
    return {**facts, **_uncertainty(found, stage.uncertainty)}


def _uncertainty(found: Estimate, before: UncertaintyParameters) -> dict[str, float]:
    """How well the machine is known now: never worse than before, and by the intervals of the estimate.

    What the record hardly tells keeps its description, and how well that is known.
    """
    turns, gap, coulomb = (
        found.parameters[name] for name in ("actuator.turns", "actuator.air_gap", "friction.coulomb")
    )
    # The mass is held, so that the forces have its uncertainty too: without them it is as open as it was.
    told = {"mass": turns, "force": turns, "air_gap": gap, "friction": coulomb}
    intervals = {
        "force": (turns.high / turns.value) ** 2 - 1.0,
        "air_gap": gap.high / gap.value - 1.0,
        "friction": coulomb.high / coulomb.value,
    }
    now = {
        name: max(least, intervals.get(name, 0.0))
        for name, least in _STAYS_OPEN.items()
        if name not in told or not told[name].poor
    }
    return {
        **{f"uncertainty.{name}": min(getattr(before, name), value) for name, value in now.items()},
        "uncertainty.shortest_delay": 1.0 - _DELAY_STAYS,
        "uncertainty.longest_delay": 1.0 + _DELAY_STAYS,
    }
