"""How far a stage may differ from its description until the linear loop is unstable; friction is left out."""

import dataclasses
from typing import NamedTuple

import numpy as np

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import closed_loop, last_stable, linearised, loop_margins, sampled_plant
from straightcomp_ros.design.searched_gains import stiffened
from straightcomp_ros.offline.sweep.scenario import Scenario

_LIGHTEST, _HEAVIEST = 0.05, 20.0


class FailingLimits(NamedTuple):
    """Between what the loop is stable.

    Attributes:
        gain_low, gain_high: factors of the loop gain.
        phase: smallest phase margin, degrees.
        longest_delay: of a command, samples.
        mass_low, mass_high: factors of the mass.
    """

    gain_low: float
    gain_high: float
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
    margins, controller = loop_margins(law, stage), linearised(law)

    def stable(factor: float) -> bool:
        platform = dataclasses.replace(stage.platform, mass=factor * stage.platform.mass)
        plant = sampled_plant(dataclasses.replace(stage, platform=platform), stage.drive.delay * stage.period)
        return bool(np.abs(np.linalg.eigvals(closed_loop(plant, controller))).max() < 1.0)

    low = high = 1.0
    if stable(1.0):
        low, high = last_stable(stable, 1.0, _LIGHTEST), last_stable(stable, 1.0, _HEAVIEST)
    longest = margins.longest_delay / stage.period
    return FailingLimits(margins.gain_low, margins.gain_high, margins.phase, longest, low, high)
