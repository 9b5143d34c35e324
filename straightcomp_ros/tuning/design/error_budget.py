"""What limits a design: the error of the same stroke with one cause of error removed at a time.

Each figure is a simulation of its own; they do not add up. RMS is the steady measure: a p-p is one extreme of a stroke,
often at a first reversal or at the end of a hold, and may even rise where a cause of error is removed. Where the loop
would be faster without the cause, the gains that are rates are made faster in the ratio of the dead times.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.design.gains import scaled, scaled_facts, with_gains
from straightcomp_ros.tuning.design.prepared_stroke import PreparedStroke, prepared_stroke
from straightcomp_ros.tuning.sweep.trial import sample_times, streams

_STARTS = 3
_FINE = 1e-3
"""Of the count: an encoder that is taken for ideal."""
_DAC_BITS = 24
_FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
_FRICTIONLESS = 1e-2
"""Of the friction: nearly none. The platform then also misses the damping that friction gives."""
_AMPLIFIER = 10.0


class BudgetEntry(NamedTuple):
    """One cause: what was removed or added, and what is left: median p-p and RMS of the true error, m."""

    cause: str
    pp: float
    rms: float


class _Variant(NamedTuple):
    """One run of the budget: the law has the description ``stage``; the delay in s."""

    cause: str
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
    """The budget of ``gains``, by dotted name; the first entry is the stage as described. ``seed`` draws the jitter."""
    found = []
    variants = _variants(scenario, law, gains, seed)
    for number, variant in enumerate(variants, 1):
        made = make_law(variant.control, variant.stage)
        runs = [variant.stroke.run(made, variant.delay, start, variant.plant) for start in range(_STARTS)]
        pp, rms = (float(np.median([getattr(run, name) for run in runs])) for name in ("pp", "rms"))
        found.append(BudgetEntry(variant.cause, pp, rms))
        progress(number / len(variants))
    return tuple(found)


def _variants(scenario: Scenario, law: str, gains: Mapping[str, float], seed: int) -> list[_Variant]:
    base, stage, plant = next(iter(scenario.controls.values())), scenario.description, scenario.driver.plant
    stroke, delay = prepared_stroke(scenario), stage.drive.delay * stage.period
    control = with_gains(base, law, gains)
    fine = scaled_facts(plant, ("encoder.y_resolution",), _FINE)
    converter = dataclasses.replace(plant.drive, dac_bits=_DAC_BITS)
    known, unheld = gains, gains
    if law == "smc_observer":
        known = {**gains, "control.smc_observer.first_size": 1.0}
        # An ideal encoder does not flicker: the command need not be held at rest, and no hold disturbs the start.
        unheld = {**gains, "control.smc_observer.rest_band": 0.0}
    free = with_gains(base, law, unheld)
    at_once = scaled_facts(stage, ("drive.delay",), 0.0)
    wide = scaled_facts(stage, ("drive.bandwidth",), _AMPLIFIER)
    # The misfit is relative to F_C: without friction it must not stiffen the law at the encoder's noise.
    observer = control.smc_observer
    calm = dataclasses.replace(observer, misfit=observer.misfit / _FRICTIONLESS)
    jitter = stage.uncertainty.jitter * stage.period
    stamps = sample_times(jitter, scenario.period_ns, scenario.samples, streams(seed, 0).clock)

    def variant(cause: str, **changes: Any) -> _Variant:
        return _Variant(cause, stroke, plant, control, stage, delay)._replace(**changes)

    return [
        variant("as described"),
        variant("ideal encoder of y", plant=fine, control=free),
        variant("ideal D/A converter", plant=dataclasses.replace(plant, drive=converter)),
        variant("ideal encoder of y and D/A converter", plant=dataclasses.replace(fine, drive=converter), control=free),
        variant("friction known from the start", control=with_gains(base, law, known)),
        variant(
            "a hundredth of the friction",
            plant=scaled_facts(plant, _FRICTION, _FRICTIONLESS),
            stage=scaled_facts(stage, _FRICTION, _FRICTIONLESS),
            control=dataclasses.replace(control, smc_observer=calm),
        ),
        variant(
            "commands that act at once, gains faster to match",
            control=with_gains(base, law, _faster(law, gains, stage, at_once)),
            stage=at_once,
            delay=0.0,
        ),
        variant(
            f"amplifier {_AMPLIFIER:g} times as fast, gains faster to match",
            plant=scaled_facts(plant, ("drive.bandwidth",), _AMPLIFIER),
            control=with_gains(base, law, _faster(law, gains, stage, wide)),
            stage=wide,
        ),
        variant("exact reference at each sample", stroke=prepared_stroke(scenario, ideal=True)),
        variant("with the jitter of the uncertainty", stroke=prepared_stroke(scenario, stamps=stamps)),
    ]


def _faster(law: str, gains: Mapping[str, float], stage: StageParameters, other: StageParameters) -> dict[str, float]:
    """``gains`` for ``stage`` as for ``other``, which has less dead time."""
    faster = scaled(law, gains, stage.dead_time / other.dead_time)
    if law == "smc_observer" and other.drive.delay == 0.0:
        faster["control.smc_observer.delay"] = 0.0
    return faster
