"""How a simulated machine differs from its description."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from straightcomp_ros.model.actuator import ActuatorParameters
from straightcomp_ros.model.friction import ContactParameters, LuGreParameters
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.parameters.declaration import ParameterError, group, parameter
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map

T = TypeVar("T", ActuatorParameters, LuGreParameters)


class Factors(NamedTuple):
    """A machine relative to its description.

    Attributes:
        mass: of the platform.
        force: of the magnets at the same gap and currents, and so K̄_i and K̄_y.
        air_gap: of the magnets.
        friction: F_C, F_S and σ2; bristles keep their stiffness and damping.
        amplifier: its bandwidth.
    """

    mass: float = 1.0
    force: float = 1.0
    air_gap: float = 1.0
    friction: float = 1.0
    amplifier: float = 1.0


@dataclass(frozen=True)
class TruthParameters:
    """How the simulated machine differs from its description."""

    mass: float = parameter(1.0, "Mass relative to the description", "[0.01, 100]")
    force: float = parameter(1.0, "Magnets' force, at the same gap and currents, relative to it", "[0.01, 100]")
    air_gap: float = parameter(1.0, "Air gap relative to it", "[0.01, 100]")
    friction: float = parameter(
        1.0, "Coulomb, static and viscous friction relative to it; bristles keep stiffness and damping", "[0.001, 1000]"
    )
    amplifier: float = parameter(1.0, "Bandwidth of the amplifier relative to it", "[0.01, 100]")
    guide: str = parameter("", "Survey file of the true guide; empty: that of the description")
    contact: ContactParameters = group(ContactParameters)

    @property
    def factors(self) -> Factors:
        """The factors as :func:`deviating` takes them."""
        return Factors(self.mass, self.force, self.air_gap, self.friction, self.amplifier)


def true_plant(stage: StageParameters, truth: TruthParameters) -> PlantParameters:
    """The simulated machine; ParameterError if its air gap does not hold the mechanical stop."""
    return dataclasses.replace(deviating(stage.plant, truth.factors), contact=truth.contact)


def true_guide(stage: StageParameters, truth: TruthParameters) -> StraightnessMap:
    """The simulated guide; SurveyError if its survey is refused."""
    return load_map(dataclasses.replace(stage.guide, file=truth.guide or stage.guide.file))


def deviating(plant: PlantParameters, factors: Factors) -> PlantParameters:
    """``plant`` with ``factors``.

    Raises:
        ParameterError: the narrower air gap does not hold the mechanical stop.
    """
    gap, stop = plant.actuator.air_gap * factors.air_gap, plant.platform.stop
    if stop >= gap:
        raise ParameterError(
            f"air gap × {factors.air_gap:.4g}: {gap:.4g} m does not hold the stop; "
            f"allowed: > {stop!r} m ('stage.platform.stop')"
        )
    platform = dataclasses.replace(plant.platform, mass=plant.platform.mass * factors.mass)
    # The area stands for turns² times area, the product in (2), and scales it exactly.
    actuator = _scaled(_scaled(plant.actuator, factors.force, "pole_area"), factors.air_gap, "air_gap")
    friction = _scaled(plant.friction, factors.friction, "coulomb", "static", "viscous")
    drive = dataclasses.replace(plant.drive, bandwidth=plant.drive.bandwidth * factors.amplifier)
    return dataclasses.replace(plant, platform=platform, actuator=actuator, friction=friction, drive=drive)


def _scaled(parameters: T, factor: float, *names: str) -> T:
    return dataclasses.replace(parameters, **{name: getattr(parameters, name) * factor for name in names})
