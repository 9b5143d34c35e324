"""What limits a design: the error of the same stroke with one cause of error removed at a time.

Each figure is a simulation of its own; they do not add up. RMS is the steady measure: a p-p is one extreme of a stroke,
often at a first reversal or at the end of a hold, and may even rise where a cause of error is removed. Where the loop
would be faster without the cause, the gains that are rates are made faster in the ratio of the dead times.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.design.course import Course, course_of
from straightcomp_ros.design.searched_gains import dead_time, scaled, with_gains
from straightcomp_ros.model.lugre import LuGreParameters
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.sweep.scenario import Scenario
from straightcomp_ros.offline.sweep.uncertainty import sample_times, streams

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
    """One run of the budget; the delay in s."""

    cause: str
    course: Course
    plant: PlantParameters
    control: ControlParameters
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
        made = make_law(variant.control, scenario.period_ns * 1e-9)
        runs = [variant.course.run(made, variant.delay, start, variant.plant) for start in range(_STARTS)]
        pp, rms = (float(np.median([getattr(run, name) for run in runs])) for name in ("pp", "rms"))
        found.append(BudgetEntry(variant.cause, pp, rms))
        progress(number / len(variants))
    return tuple(found)


def _variants(scenario: Scenario, law: str, gains: Mapping[str, float], seed: int) -> list[_Variant]:
    base = next(iter(scenario.controls.values()))
    period, samples = scenario.period_ns * 1e-9, scenario.driver.lockstep_delay
    plant, delay = scenario.driver.simulated.plant, samples * period
    control = with_gains(base, law, gains)
    course = course_of(scenario)
    encoder = dataclasses.replace(plant.encoder, resolution=_FINE * plant.encoder.resolution)
    converter = dataclasses.replace(plant.drive, dac_bits=_DAC_BITS)
    exact_sensors = dataclasses.replace(plant, encoder=encoder, drive=converter)
    known, unheld = gains, gains
    if law == "smc_observer":
        known = {**gains, "control.smc_observer.first_size": 1.0}
        # An ideal encoder does not flicker: the command need not be held at rest, and no hold disturbs the start.
        unheld = {**gains, "control.smc_observer.rest_band": 0.0}
    free = with_gains(base, law, unheld)
    smooth, believed = _without_friction(plant, control)
    at_once, faster = _without_delay(base, law, gains, period, samples), _amplifier(plant)
    wide = dataclasses.replace(
        base, nominal=dataclasses.replace(base.nominal, amplifier_bandwidth=faster.drive.bandwidth)
    )
    quicker = scaled(law, gains, dead_time(base, period, samples) / dead_time(wide, period, samples))
    stamps = sample_times(scenario.uncertainty.jitter, scenario.period_ns, scenario.samples, streams(seed, 0).clock)
    return [
        _Variant("as described", course, plant, control, delay),
        _Variant("ideal encoder of y", course, dataclasses.replace(plant, encoder=encoder), free, delay),
        _Variant("ideal D/A converter", course, dataclasses.replace(plant, drive=converter), control, delay),
        _Variant("ideal encoder of y and D/A converter", course, exact_sensors, free, delay),
        _Variant("friction known from the start", course, plant, with_gains(base, law, known), delay),
        _Variant("a hundredth of the friction", course, smooth, believed, delay),
        _Variant("commands that act at once, gains faster to match", course, plant, at_once, 0.0),
        _Variant(
            f"amplifier {_AMPLIFIER:g} times as fast, gains faster to match",
            course,
            faster,
            with_gains(wide, law, quicker),
            delay,
        ),
        _Variant("exact reference at each sample", course_of(scenario, ideal=True), plant, control, delay),
        _Variant("with the jitter of the uncertainty", course_of(scenario, stamps=stamps), plant, control, delay),
    ]


def _without_friction(plant: PlantParameters, control: ControlParameters) -> tuple[PlantParameters, ControlParameters]:
    """A plant nearly without friction, and the law that knows it."""
    friction = plant.friction
    less = {name: _FRICTIONLESS * getattr(friction, name) for name in ("coulomb", "static", "viscous")}
    design = control.smc_observer
    lugre: LuGreParameters = dataclasses.replace(design.lugre, **less)
    return (
        dataclasses.replace(plant, friction=dataclasses.replace(friction, **less)),
        # The misfit is relative to F_C: it must not stiffen the law at the encoder's noise.
        dataclasses.replace(
            control, smc_observer=dataclasses.replace(design, lugre=lugre, misfit=design.misfit / _FRICTIONLESS)
        ),
    )


def _without_delay(
    base: ControlParameters, law: str, gains: Mapping[str, float], period: float, samples: float
) -> ControlParameters:
    faster = scaled(law, gains, dead_time(base, period, samples) / dead_time(base, period, 0.0))
    if law == "smc_observer":
        faster["control.smc_observer.delay"] = 0.0
    return with_gains(base, law, faster)


def _amplifier(plant: PlantParameters) -> PlantParameters:
    drive = dataclasses.replace(plant.drive, bandwidth=_AMPLIFIER * plant.drive.bandwidth)
    return dataclasses.replace(plant, drive=drive)
