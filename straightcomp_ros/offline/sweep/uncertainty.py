"""How far the machine may be from the one that the controller was designed for, and one such machine per trial.

Trial k of a seed is the same in any process and order: its random numbers come from the k-th child of the seed
(:class:`numpy.random.SeedSequence`), in four streams, so that a longer stroke or another parameter's range changes no
other quantity. numpy promises the bits of its distributions within a version only.
"""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from straightcomp_ros.model.actuator import ActuatorParameters
from straightcomp_ros.model.lugre import FrictionParameters
from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.settings.declaration import RefusedParameter, parameter
from straightcomp_ros.straightness.survey import Survey

T = TypeVar("T", ActuatorParameters, FrictionParameters)


@dataclass(frozen=True)
class UncertaintyParameters:
    """Ranges of a sweep. The amplifier's bandwidth, the converters and the guide stay nominal."""

    mass: float = parameter(0.2, "Mass: uniform within ± this fraction of it", "[0, 0.9]")
    force: float = parameter(
        0.2,
        "Force of the magnets at the same gap and currents (turns² times pole area, and so K̄_i and K̄_y): uniform "
        "within ± this fraction of it",
        "[0, 0.9]",
    )
    air_gap: float = parameter(0.1, "Air gap: uniform within ± this fraction of it", "[0, 0.9]")
    friction: float = parameter(
        2.0,
        "Coulomb, static and viscous friction: log-uniform between one over this factor and this factor; bristles "
        "keep their stiffness and damping",
        "[1, 100]",
    )
    sensor_noise: float = parameter(
        0.05e-6,
        "Noise on y before the encoder rounds: normal, white; its standard deviation is uniform from 0 to this",
        "[0, 0.0001] m",
    )
    shortest_delay: float = parameter(0.2, "Command delay, constant in a trial: uniform from this", "[0, 10] samples")
    longest_delay: float = parameter(1.5, "Command delay, constant in a trial: uniform up to this", "[0, 10] samples")
    jitter: float = parameter(
        20e-6,
        "Time from each sample's place on the grid: uniform within ± this; the stamp tells the true time",
        "[0, 0.01] s",
    )
    map_noise: float = parameter(
        0.02e-6, "Standard deviation of an error of each point of the survey: normal", "[0, 1e-5] m"
    )

    def __post_init__(self) -> None:
        if self.longest_delay < self.shortest_delay:
            raise RefusedParameter(
                "longest_delay",
                f"{self.longest_delay!r} samples is below the shortest; allowed: >= {self.shortest_delay!r} samples "
                "('{group}shortest_delay')",
            )


class Streams(NamedTuple):
    """Random numbers of one trial, by purpose."""

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
    """The random numbers of trial ``trial`` (from 0), as of ``SeedSequence(seed).spawn(n)[trial]`` for any n."""
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
    """``plant`` with ``deviation``; ParameterError if the narrower air gap does not hold the mechanical stop."""
    # The area stands for turns² times area, the product in (2), and scales it exactly.
    actuator = _scaled(_scaled(plant.actuator, deviation.force, "pole_area"), deviation.air_gap, "air_gap")
    friction = _scaled(plant.friction, deviation.friction, "coulomb", "static", "viscous")
    return dataclasses.replace(plant, mass=plant.mass * deviation.mass, actuator=actuator, friction=friction)


def _scaled(parameters: T, factor: float, *names: str) -> T:
    return dataclasses.replace(parameters, **{name: getattr(parameters, name) * factor for name in names})


def sample_times(jitter: float, period_ns: int, count: int, random: Generator) -> NDArray[np.int64]:
    """Stamps (count,) in ns from 0, around a grid of ``period_ns``; ``jitter`` in s does not add up."""
    largest = round(jitter * 1e9)
    stamps = np.arange(count) * period_ns + random.integers(-largest, largest, count, endpoint=True)
    stamps[0] = 0
    return stamps


def mismeasured(survey: Survey, noise: float, random: Generator) -> Survey:
    """``survey`` with an error of standard deviation ``noise`` (m) in each point."""
    errors = [noise * random.standard_normal(run.x.size) for run in survey.runs]
    runs = [dataclasses.replace(run, deviation=run.deviation + e) for run, e in zip(survey.runs, errors, strict=True)]
    return Survey(tuple(runs), survey.source)
