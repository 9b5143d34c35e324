"""How far the machine may be from the one that the controller was designed for, and one such machine per trial.

Trial k of a seed is the same whoever runs it, whatever ran before: its random numbers come from the k-th child of the
seed (:class:`numpy.random.SeedSequence`), in four streams, so that a longer stroke or another parameter's range
changes no other quantity. numpy keeps its distributions' bits within a version, but does not promise them across
versions.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.settings.declaration import RefusedParameter, parameter
from straightcomp_ros.straightness.survey import Run, Survey


@dataclass(frozen=True)
class UncertaintyParameters:
    """Ranges of a sweep. The amplifier's bandwidth, the converters and the guide stay as the machine has them."""

    mass: float = parameter(0.2, "Mass: uniform within ± this part of it", minimum=0.0, maximum=0.9)
    force: float = parameter(
        0.2,
        "Force of the magnets at the same gap and currents (turns² times pole area, and so K̄_i and K̄_y): uniform "
        "within ± this part of it",
        minimum=0.0,
        maximum=0.9,
    )
    air_gap: float = parameter(0.1, "Air gap: uniform within ± this part of it", minimum=0.0, maximum=0.9)
    friction: float = parameter(
        2.0,
        "Coulomb, static and viscous friction: log-uniform between one over this factor and this factor; the "
        "stiffness and damping of the bristles stay",
        minimum=1.0,
        maximum=100.0,
    )
    sensor_noise: float = parameter(
        0.05e-6,
        "Noise on y before the encoder rounds: normal, white; its standard deviation uniform from 0 to this",
        unit="m",
        minimum=0.0,
        maximum=1e-4,
    )
    shortest_delay: float = parameter(
        0.2, "Command delay: uniform from this, the same for all of a trial", unit="samples", minimum=0.0, maximum=10.0
    )
    longest_delay: float = parameter(
        1.5, "Command delay: uniform up to this", unit="samples", minimum=0.0, maximum=10.0
    )
    jitter: float = parameter(
        20e-6,
        "Each sample is taken up to this before or after its place on the grid: uniform; its stamp says when",
        unit="s",
        minimum=0.0,
        maximum=1e-2,
    )
    map_noise: float = parameter(
        0.02e-6,
        "Standard deviation of an error of each point of the survey: normal",
        unit="m",
        minimum=0.0,
        maximum=1e-5,
    )

    def __post_init__(self) -> None:
        if self.longest_delay < self.shortest_delay:
            raise RefusedParameter(
                "longest_delay",
                f"{self.longest_delay!r} samples is below the shortest; allowed: >= {self.shortest_delay!r} samples "
                "('{group}shortest_delay')",
            )


EXACT = UncertaintyParameters(
    mass=0.0, force=0.0, air_gap=0.0, friction=1.0, sensor_noise=0.0, shortest_delay=0.5, longest_delay=0.5, jitter=0.0,
    map_noise=0.0,
)  # fmt: skip
"""The machine that the controller was designed for, and half a sample's delay as the simulation has."""


class Streams(NamedTuple):
    """Random numbers of one trial, by what they are for."""

    machine: Generator
    sensor: Generator
    clock: Generator
    survey: Generator


class Deviation(NamedTuple):
    """One machine: factors of mass, force, air gap and friction; sensor noise in m; command delay in samples."""

    mass: float
    force: float
    air_gap: float
    friction: float
    sensor_noise: float
    delay: float


def streams(seed: int, trial: int) -> Streams:
    """The random numbers of trial ``trial`` (from 0): those of ``SeedSequence(seed).spawn(n)[trial]``, any n."""
    children = SeedSequence(seed, spawn_key=(trial,)).spawn(len(Streams._fields))
    return Streams(*map(default_rng, children))


def draw(ranges: UncertaintyParameters, random: Generator) -> Deviation:
    """A machine within ``ranges``."""
    u = random.random(len(Deviation._fields)).tolist()
    return Deviation(
        mass=1.0 + ranges.mass * (2.0 * u[0] - 1.0),
        force=1.0 + ranges.force * (2.0 * u[1] - 1.0),
        air_gap=1.0 + ranges.air_gap * (2.0 * u[2] - 1.0),
        friction=ranges.friction ** (2.0 * u[3] - 1.0),
        sensor_noise=ranges.sensor_noise * u[4],
        delay=ranges.shortest_delay + (ranges.longest_delay - ranges.shortest_delay) * u[5],
    )


def deviating(plant: PlantParameters, deviation: Deviation) -> PlantParameters:
    """``plant`` as ``deviation`` makes it.

    Raises:
        ParameterError: the narrower air gap does not hold the mechanical stop.
    """
    actuator, friction = plant.actuator, plant.friction
    return dataclasses.replace(
        plant,
        mass=plant.mass * deviation.mass,
        actuator=dataclasses.replace(
            actuator,
            # (2) holds turns² and area as one product; the area is the one that scales it exactly.
            pole_area=actuator.pole_area * deviation.force,
            air_gap=actuator.air_gap * deviation.air_gap,
        ),
        friction=dataclasses.replace(
            friction,
            coulomb=friction.coulomb * deviation.friction,
            static=friction.static * deviation.friction,
            viscous=friction.viscous * deviation.friction,
        ),
    )


def sample_times(jitter: float, period_ns: int, count: int, random: Generator) -> NDArray[np.int64]:
    """Stamps (count,) in ns from 0, around a grid of ``period_ns``; ``jitter`` in s does not add up."""
    largest = round(jitter * 1e9)
    stamps = np.arange(count) * period_ns + random.integers(-largest, largest, count, endpoint=True)
    # The first sample is what the others are counted from.
    stamps[0] = 0
    return stamps


def mismeasured(survey: Survey, noise: float, random: Generator) -> Survey:
    """``survey`` with an error of standard deviation ``noise`` (m) in each point."""
    runs = tuple(
        Run(run.name, run.direction, run.x, run.deviation + noise * random.standard_normal(run.x.size))
        for run in survey.runs
    )
    return Survey(runs, survey.source)
