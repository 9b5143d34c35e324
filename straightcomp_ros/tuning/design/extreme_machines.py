"""A handful of machines at the ends of the uncertainty, on which a law must neither oscillate nor fail."""

from typing import NamedTuple

from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.stage.description import Factors, UncertaintyParameters, deviating


class Extreme(NamedTuple):
    """A machine by name, and the delay of its commands in samples."""

    name: str
    plant: PlantParameters
    delay: float


def extreme_machines(scenario: Scenario) -> list[Extreme]:
    """The machines: each has the loop gain, the friction and the delay of one end of its range."""
    ranges, delay = scenario.description.uncertainty, scenario.description.drive.delay
    latest, soonest = delay * max(1.0, ranges.longest_delay), delay * min(1.0, ranges.shortest_delay)
    return [
        _machine(scenario, "most gain, least friction, late", 1.0, -1.0, latest),
        _machine(scenario, "most gain, most friction, late", 1.0, 1.0, latest),
        _machine(scenario, "least gain, most friction", -1.0, 1.0, delay),
        _machine(scenario, "least gain, least friction, soon", -1.0, -1.0, soonest),
        _machine(scenario, "most friction, late", 0.0, 1.0, latest),
        _machine(scenario, "least friction", 0.0, -1.0, delay),
    ]


def _machine(scenario: Scenario, name: str, gain: float, friction: float, delay: float) -> Extreme:
    """``gain`` and ``friction`` from −1 to 1 say where in its range each lies."""
    plant = deviating(scenario.driver.plant, _factors(scenario.description.uncertainty, gain, friction))
    return Extreme(name, plant, delay)


def _factors(ranges: UncertaintyParameters, gain: float, friction: float) -> Factors:
    return Factors(
        mass=1.0 - gain * ranges.mass,
        force=1.0 + gain * ranges.force,
        air_gap=1.0 - gain * ranges.air_gap,
        friction=ranges.friction**friction,
    )
