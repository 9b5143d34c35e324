"""How far a stage may differ from its description until the linear loop is unstable; friction is left out."""

import dataclasses
from typing import NamedTuple

from straightcomp_ros.control.laws import ControlParameters, make_law, stiffened
from straightcomp_ros.control.margins import (
    closed_loop,
    last_stable,
    linearised,
    loop_margins,
    sampled_plant,
    spectral_radius,
)
from straightcomp_ros.offline.scenario import Scenario

_LIGHTEST, _HEAVIEST = 0.05, 20.0


class FailingLimits(NamedTuple):
    """Between what the loop is stable.

    Attributes:
        gain_low, gain_high: factors of the loop gain.
        amplifier_low, amplifier_high: factors of the amplifier's gain, with the current measured behind it.
        phase: smallest phase margin, with and without the measured current, degrees.
        longest_delay: of a command, samples.
        mass_low, mass_high: factors of the mass.
    """

    gain_low: float
    gain_high: float
    amplifier_low: float
    amplifier_high: float
    phase: float
    longest_delay: float
    mass_low: float
    mass_high: float


def failing_limits(scenario: Scenario, control: ControlParameters) -> dict[str, FailingLimits]:
    """The limits of a law by its state: ``quiet``, and for a law that stiffens ``stiff``."""
    stiff = stiffened(control)
    ends = {"quiet": control} if stiff is control else {"quiet": control, "stiff": stiff}
    return {name: _limits(scenario, one) for name, one in ends.items()}


def _limits(scenario: Scenario, control: ControlParameters) -> FailingLimits:
    stage = scenario.description
    law = make_law(control, stage)
    margins, measured = loop_margins(law, stage), loop_margins(law, stage, with_current=True)
    controller = linearised(law)

    def stable(factor: float) -> bool:
        platform = dataclasses.replace(stage.platform, mass=factor * stage.platform.mass)
        plant = sampled_plant(dataclasses.replace(stage, platform=platform), stage.drive.delay * stage.period)
        return spectral_radius(closed_loop(plant, controller)) < 1.0

    low = high = 1.0
    if stable(1.0):
        low, high = last_stable(stable, 1.0, _LIGHTEST), last_stable(stable, 1.0, _HEAVIEST)
    return FailingLimits(
        gain_low=margins.gain_low,
        gain_high=margins.gain_high,
        amplifier_low=measured.gain_low,
        amplifier_high=measured.gain_high,
        phase=min(margins.phase, measured.phase),
        longest_delay=margins.longest_delay / stage.period,
        mass_low=low,
        mass_high=high,
    )
