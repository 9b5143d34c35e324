"""How far a run may go, from the parameters and the map that it ran with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap


class Bounds(NamedTuple):
    """Bounds of a run; infinite where they are unknown.

    Attributes:
        current: largest |i_c| in A that the law may command and the D/A converter can.
        stop: the platform's mechanical stop at ± this position, m.
        first, last: x in m from which and up to which the map has a reference that follows the guide or runs out.
    """

    current: float = math.inf
    stop: float = math.inf
    first: float = -math.inf
    last: float = math.inf

    def within(self, straightness: StraightnessMap, runout: float) -> Bounds:
        """These bounds, with those of x from a map that runs out over ``runout`` in m."""
        first, last = straightness.span
        return self._replace(first=first - runout, last=last + runout)


def bounds_of(parameters: Mapping[str, Mapping[str, Any]], straightness: StraightnessMap | None = None) -> Bounds:
    """Bounds from parameters of each node alone, by dotted name, as a bag has them.

    A node that is there has its defaults for what is not named; of one that is not, nothing is known. A board on CAN
    tells neither its stop nor its converter, unless it is the emulator.
    """
    bounds, shipped = Bounds(), StageParameters()
    if "controller" in parameters:
        limit = parameters["controller"].get("stage.actuator.current_limit", shipped.actuator.current_limit)
        bounds = Bounds(current=float(limit))
    driver = parameters.get("driver", {"hardware": "unknown"})
    if driver.get("hardware", "simulated") == "simulated" or driver.get("can.simulated_stage", False):
        stop = float(driver.get("stage.platform.stop", shipped.platform.stop))
        bounds = bounds._replace(stop=stop, current=min(bounds.current, recorded_drive(driver).largest_current))
    if straightness is None:
        return bounds
    runout = parameters.get("feedforward", {}).get("stage.guide.runout", shipped.guide.runout)
    return bounds.within(straightness, float(runout))


def recorded_drive(driver: Mapping[str, Any]) -> DriveParameters:
    """D/A converter and amplifier from the driver's parameters by dotted name; defaults for what they do not name."""
    given = {name: driver.get(f"stage.drive.{name}", value) for name, value in asdict(DriveParameters()).items()}
    return DriveParameters(int(given.pop("dac_bits")), *map(float, given.values()))
