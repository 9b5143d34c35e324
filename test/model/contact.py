"""Friction alone, and the plant, as the tests of friction beyond plain LuGre move them."""

import math

import numpy as np

from straightcomp_ros.model.extended_friction import (
    BLOCK,
    extended_force,
    lugre_now,
    step_friction,
)
from straightcomp_ros.model.maxwell_slip import MOST_BLOCKS
from straightcomp_ros.model.plant import PlantParameters, PlantState, advance, as_array
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters, TruthParameters, true_plant

STEP = 25e-6
CHANGES = {
    "contact.bands.fraction": 0.3,
    "contact.bands.seed": 7,
    "contact.rest.growth": 0.2,
    "contact.step.factor": 1.7,
    "contact.step.time": 0.02,
}
SLIP = {"contact.model": "maxwell_slip"}
UNDAMPED = {"friction.bristle_damping": 0.0, "friction.viscous": 0.0}
KINDS = [SLIP, CHANGES, {**SLIP, **CHANGES}, {**SLIP, "contact.maxwell_slip.attraction": 1e9}]


def plant_with(values) -> PlantParameters:
    """The simulated machine with these values of ``contact.…``; all others are of its description."""
    contact = {name: value for name, value in values.items() if name.startswith("contact.")}
    described = {name: value for name, value in values.items() if name not in contact}
    return true_plant(from_mapping(StageParameters, described), from_mapping(TruthParameters, contact))


class Contact:
    """Friction alone, moved as the test says; the functions that the plant calls, as plain Python."""

    def __init__(self, values) -> None:
        self.parameters = plant_with(values)
        self.plant = self.parameters.constants()
        self.constants = as_array(self.plant)
        self.state = np.array(PlantState())
        self.place, self.force = 0.0, 0.0

    def move(self, velocity: float, duration: float = STEP) -> float:
        """Friction after a step at constant velocity."""
        self.place += velocity * duration
        lugre = lugre_now(self.constants, self.plant.lugre, self.state, self.place)
        step_friction(self.constants, lugre, self.state, velocity, duration)
        self.force = extended_force(self.constants, lugre, self.state, velocity)
        return self.force

    def go(self, distance: float, speed: float = 1e-5, steps: int = 200) -> list[float]:
        """Forces on a way of this length with this sign."""
        duration = abs(distance) / speed / steps
        return [self.move(math.copysign(speed, distance), duration) for _ in range(steps)]

    def stored(self) -> float:
        """Energy in the springs, J."""
        if self.parameters.contact.model == "lugre":
            return 0.5 * self.plant.lugre.bristle_stiffness * float(self.state[2]) ** 2
        count = self.parameters.contact.maxwell_slip.blocks
        blocks = self.state[BLOCK : BLOCK + count]
        springs = np.array(self.plant.extension[12 : 12 + count])
        return float(0.5 * np.sum(blocks**2 / springs))


def run(values, start: PlantState, command: float, samples: int, bias: float = 1.0) -> np.ndarray:
    """States after each half millisecond, (samples, fields)."""
    constants, state = as_array(plant_with(values).constants()), np.array(start)
    states = []
    for _ in range(samples):
        advance(constants, state, bias, command, 500_000)
        states.append(state.copy())
    return np.array(states)


def spring_force(contact: Contact) -> float:
    if contact.parameters.contact.model == "lugre":
        return contact.plant.lugre.bristle_stiffness * float(contact.state[2])
    return float(contact.state[BLOCK : BLOCK + MOST_BLOCKS].sum())
