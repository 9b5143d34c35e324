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
from straightcomp_ros.model.lugre import LuGreParameters
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.design.prepared_stroke import PreparedStroke, prepared_stroke
from straightcomp_ros.tuning.design.searched_gains import scaled, with_gains
from straightcomp_ros.tuning.sweep.trial import sample_times, streams

_STARTS = 3
_FINE = 1e-3
"""Of the count: an encoder that is taken for ideal."""
_DAC_BITS = 24
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
    course: PreparedStroke
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
    """The budget of ``gains``; the first entry is the stage as described.

    Args:
        scenario: the stage.
        law: name of the law.
        gains: by dotted name.
        seed: of the jitter.
        progress: called with the fraction that is done.
    """
    found = []
    variants = _variants(scenario, law, gains, seed)
    for number, variant in enumerate(variants, 1):
        made = make_law(variant.control, variant.stage)
        runs = [variant.course.run(made, variant.delay, start, variant.plant) for start in range(_STARTS)]
        pp, rms = (float(np.median([getattr(run, name) for run in runs])) for name in ("pp", "rms"))
        found.append(BudgetEntry(variant.cause, pp, rms))
        progress(number / len(variants))
    return tuple(found)


def _variants(scenario: Scenario, law: str, gains: Mapping[str, float], seed: int) -> list[_Variant]:
    base, stage, plant = next(iter(scenario.controls.values())), scenario.description, scenario.driver.plant
    course, delay = prepared_stroke(scenario), stage.drive.delay * stage.period
    control = with_gains(base, law, gains)
    encoder = dataclasses.replace(plant.encoder, y_resolution=_FINE * plant.encoder.y_resolution)
    converter = dataclasses.replace(plant.drive, dac_bits=_DAC_BITS)
    faster = dataclasses.replace(plant.drive, bandwidth=_AMPLIFIER * plant.drive.bandwidth)
    known, unheld = gains, gains
    if law == "smc_observer":
        known = {**gains, "control.smc_observer.first_size": 1.0}
        # An ideal encoder does not flicker: the command need not be held at rest, and no hold disturbs the start.
        unheld = {**gains, "control.smc_observer.rest_band": 0.0}
    free = with_gains(base, law, unheld)
    at_once = dataclasses.replace(stage, drive=dataclasses.replace(stage.drive, delay=0.0))
    wide = dataclasses.replace(
        stage, drive=dataclasses.replace(stage.drive, bandwidth=_AMPLIFIER * stage.drive.bandwidth)
    )
    jitter = stage.uncertainty.jitter * stage.period
    stamps = sample_times(jitter, scenario.period_ns, scenario.samples, streams(seed, 0).clock)

    def variant(cause: str, own: Mapping[str, Any] | None = None, **changes: Any) -> _Variant:
        """As described, with other parts of the plant in ``own``, and other fields of the variant."""
        plain = _Variant(cause, course, dataclasses.replace(plant, **(own or {})), control, stage, delay)
        return plain._replace(**changes)

    return [
        variant("as described"),
        variant("ideal encoder of y", {"encoder": encoder}, control=free),
        variant("ideal D/A converter", {"drive": converter}),
        variant("ideal encoder of y and D/A converter", {"encoder": encoder, "drive": converter}, control=free),
        variant("friction known from the start", control=with_gains(base, law, known)),
        _without_friction(variant("a hundredth of the friction")),
        variant(
            "commands that act at once, gains faster to match",
            control=with_gains(base, law, _faster(law, gains, stage, at_once)),
            stage=at_once,
            delay=0.0,
        ),
        variant(
            f"amplifier {_AMPLIFIER:g} times as fast, gains faster to match",
            {"drive": faster},
            control=with_gains(base, law, _faster(law, gains, stage, wide)),
            stage=wide,
        ),
        variant("exact reference at each sample", course=prepared_stroke(scenario, ideal=True)),
        variant("with the jitter of the uncertainty", course=prepared_stroke(scenario, stamps=stamps)),
    ]


def _without_friction(variant: _Variant) -> _Variant:
    """A plant nearly without friction, and the law that knows it."""

    def less(friction: LuGreParameters) -> LuGreParameters:
        changed = {name: _FRICTIONLESS * getattr(friction, name) for name in ("coulomb", "static", "viscous")}
        return dataclasses.replace(friction, **changed)

    plant, stage, design = variant.plant, variant.stage, variant.control.smc_observer
    # The misfit is relative to F_C: it must not stiffen the law at the encoder's noise.
    calm = dataclasses.replace(design, misfit=design.misfit / _FRICTIONLESS)
    return variant._replace(
        plant=dataclasses.replace(plant, friction=less(plant.friction)),
        stage=dataclasses.replace(stage, friction=less(stage.friction)),
        control=dataclasses.replace(variant.control, smc_observer=calm),
    )


def _faster(law: str, gains: Mapping[str, float], stage: StageParameters, other: StageParameters) -> dict[str, float]:
    """``gains`` for ``stage`` as for ``other``, which has less dead time."""
    faster = scaled(law, gains, stage.dead_time / other.dead_time)
    if law == "smc_observer" and other.drive.delay == 0.0:
        faster["control.smc_observer.delay"] = 0.0
    return faster
