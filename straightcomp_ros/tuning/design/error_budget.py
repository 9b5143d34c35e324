"""What limits a design: the error of the same stroke with one cause of error removed, or added, at a time.

Each figure is a simulation of its own; they do not add up. RMS is the steady measure: a p-p is one extreme of a stroke,
often at a first reversal or at the end of a hold, and may even rise where a cause of error is removed. Where the loop
would be faster without the cause, the gains that are rates are made faster in the ratio of the dead times.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control.filters import FilterParameters
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import AS_DESCRIBED, unstable_where
from straightcomp_ros.model.disturbances import GRAVITY, DisturbanceParameters
from straightcomp_ros.model.modes import ModesParameters
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import map_of
from straightcomp_ros.tuning.design.gain_search import PreparedStroke, prepared_stroke
from straightcomp_ros.tuning.design.gains import rule, scaled, scaled_facts, with_gains
from straightcomp_ros.tuning.sweep.trial import mismeasured, sample_times, streams

_STARTS = 3
_FINE = 1e-3
"""Of the count: an encoder that is taken for ideal."""
_DAC_BITS = 24
_FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
_FRICTIONLESS = 1e-2
"""Of the friction: nearly none. The platform then also misses the damping that friction gives."""
_AMPLIFIER = 10.0
_QUANTA = 10.0
"""Forces of a count and a step of the converter that stand for F_C where there is none."""


class BudgetEntry(NamedTuple):
    """One cause: what was removed or added, and what is left: median p-p and RMS of the true error, m."""

    cause: str
    pp: float
    rms: float


NOTED = 1.5
"""Ratio to the stage's own figure from which a cause is remarked on: a p-p moves by as much from stroke to stroke."""


def remarks(budget: Sequence[BudgetEntry], unit: float = 1.0) -> list[str]:
    """What a budget shows against its design, a sentence each; ``unit`` makes µm of its figures.

    A cause that was added may leave more; one that was removed may not.
    """
    own, *others = budget or (BudgetEntry("", 0.0, 0.0),)
    found = []
    for one in others:
        if one.cause.startswith("with ") or max(one.pp / own.pp, one.rms / own.rms) <= NOTED:
            continue
        figures = f"{one.pp * unit:.2g} µm p-p instead of {own.pp * unit:.2g}, {one.rms * unit:.2g} RMS instead of "
        figures += f"{own.rms * unit:.2g}"
        reason = "the gains rely on what is gone, so that a machine like that needs its own"
        found.append(f"“{one.cause}” would leave more: {figures}; {reason}.")
    return found


class _Run(NamedTuple):
    """What runs: the law has the description ``stage``; the delay in s."""

    stroke: PreparedStroke
    plant: PlantParameters
    control: ControlParameters
    stage: StageParameters
    delay: float


def error_budget(
    scenario: Scenario,
    law: str,
    gains: Mapping[str, float],
    *,
    seed: int = 1,
    progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[BudgetEntry, ...]:
    """The budget of ``gains``, by dotted name; the first entry is the stage as described. What would be unstable is
    left out. ``seed`` draws the jitter."""
    found, stage = [], scenario.description
    # Another drive or platform may make the gains that are scaled for it unstable: that is no limit of this one.
    causes = {
        cause: one
        for cause, one in _causes(scenario, law, gains, seed).items()
        if one.stage is stage or unstable_where(one.control, one.stage) != AS_DESCRIBED
    }
    for number, (cause, one) in enumerate(causes.items(), 1):
        made = make_law(one.control, one.stage)
        runs = [one.stroke.run(made, one.delay, start, one.plant) for start in range(_STARTS)]
        pp, rms = (float(np.median([getattr(run, name) for run in runs])) for name in ("pp", "rms"))
        found.append(BudgetEntry(cause, pp, rms))
        progress(number / len(causes))
    return tuple(found)


def _causes(scenario: Scenario, law: str, gains: Mapping[str, float], seed: int) -> dict[str, _Run]:
    base, stage, plant = next(iter(scenario.controls.values())), scenario.description, scenario.driver.plant
    control = with_gains(base, law, gains)
    own = _Run(prepared_stroke(scenario), plant, control, stage, stage.delay)
    fine = scaled_facts(plant, ("encoder.y_resolution",), _FINE)
    converter = dataclasses.replace(plant.drive, dac_bits=_DAC_BITS)
    known, free = control, control
    if law == "smc_observer":
        known = with_gains(base, law, {**gains, "control.smc_observer.first_size": 1.0})
        # An ideal encoder does not flicker: the command need not be held at rest, and no hold disturbs the start.
        free = with_gains(base, law, {**gains, "control.smc_observer.rest_band": 0.0})
    # The misfit is relative to F_C: without friction it must not stiffen the law at the encoder's noise.
    observer = control.smc_observer
    calm = dataclasses.replace(observer, misfit=observer.misfit / _FRICTIONLESS)
    jitter = stage.uncertainty.jitter * stage.period
    stamps = sample_times(jitter, stage.period_ns, scenario.samples, streams(seed, 0).clock)

    noise = map_of(scenario.survey, scenario.followed.guide).noise
    again = mismeasured(scenario.survey, noise.point * math.sqrt(noise.runs), streams(seed, 0).survey)

    def faster(fact: str, factor: float) -> tuple[StageParameters, ControlParameters]:
        """The stage with a fact of its drive changed, and gains for it as those for the stage."""
        other = scaled_facts(stage, (fact,), factor)
        quick = scaled(law, gains, stage.dead_time / other.dead_time)
        if law == "smc_observer" and other.drive.delay == 0.0:
            quick["control.smc_observer.delay"] = 0.0
        return other, with_gains(base, law, quick)

    at_once, of_at_once = faster("drive.delay", 0.0)
    wide, of_wide = faster("drive.bandwidth", _AMPLIFIER)
    return {
        "as described": own,
        "ideal encoder of y": own._replace(plant=fine, control=free),
        "ideal D/A converter": own._replace(plant=dataclasses.replace(plant, drive=converter)),
        "ideal encoder of y and D/A converter": own._replace(
            plant=dataclasses.replace(fine, drive=converter), control=free
        ),
        "friction known from the start": own._replace(control=known),
        "a hundredth of the friction": own._replace(
            plant=scaled_facts(plant, _FRICTION, _FRICTIONLESS),
            stage=scaled_facts(stage, _FRICTION, _FRICTIONLESS),
            control=dataclasses.replace(control, smc_observer=calm),
        ),
        "commands that act at once, gains faster to match": own._replace(stage=at_once, control=of_at_once, delay=0.0),
        f"amplifier {_AMPLIFIER:g} times as fast, gains faster to match": own._replace(
            plant=scaled_facts(plant, ("drive.bandwidth",), _AMPLIFIER), stage=wide, control=of_wide
        ),
        "exact reference at each sample": own._replace(stroke=prepared_stroke(scenario, ideal=True)),
        "with the noise of the survey once more in it": own._replace(stroke=prepared_stroke(scenario, survey=again)),
        "with the jitter of the uncertainty": own._replace(stroke=prepared_stroke(scenario, stamps=stamps)),
        **_rigid(own, gains, law),
        **_disturbed(own),
    }


def _rigid(own: _Run, gains: Mapping[str, float], law: str) -> dict[str, _Run]:
    """The same without the platform's modes and what they cost in filters and bandwidth, if it has any."""
    if not own.plant.platform.modes.present:
        return {}
    stage = own.stage.with_modes()
    plant = dataclasses.replace(own.plant, platform=dataclasses.replace(own.plant.platform, modes=ModesParameters()))
    control = dataclasses.replace(
        with_gains(own.control, law, {**gains, **rule(law, stage)}), filters=FilterParameters()
    )
    rigid = own._replace(plant=plant, stage=stage, control=control)
    return {"rigid platform, no filters, gains in closed form": rigid}


def _disturbed(own: _Run) -> dict[str, _Run]:
    """Each disturbance added to the machine, of a size that its friction or, without any, its converters give."""
    stiffness = own.stage.actuator.current_stiffness
    force = own.stage.friction.coulomb or _QUANTA * own.stage.quantum
    tenth = 0.1 * force
    sizes = {
        f"with mains of {tenth:.2g} N at 50 Hz": {"mains.force": tenth},
        f"with cogging of {force:.2g} N over 30 mm": {"cogging.force": force},
        f"with cables that drag with {tenth:.2g} N": {"cable.drag": tenth},
        f"with a constant force of {force:.2g} N (tilt)": {
            "tilt": math.asin(min(1.0, force / (GRAVITY * own.stage.platform.mass)))
        },
        f"with an amplifier's offset that drifts by {tenth / stiffness * 1e3:.2g} mA RMS in 1 s": {
            "drift.current": tenth / stiffness
        },
        f"with a guide that vibrates with {tenth / own.stage.platform.mass:.2g} m/s² RMS at 30 Hz": {
            "vibration.acceleration": tenth / own.stage.platform.mass
        },
        "with an interpolation error of half a count of y": {
            "interpolation.amplitude": min(1e-4, 0.5 * own.stage.encoder.y_resolution)
        },
    }
    plants = {
        cause: dataclasses.replace(own.plant, disturbances=from_mapping(DisturbanceParameters, values).machine())
        for cause, values in sizes.items()
    }
    return {cause: own._replace(plant=plant) for cause, plant in plants.items()}
