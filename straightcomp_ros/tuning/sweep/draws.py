"""One machine for each trial, within the uncertainty of the stage's description.

Trial k of a seed is the same in any process and order: its random numbers come from the k-th child of the seed
(:class:`numpy.random.SeedSequence`), in four streams, so that a longer stroke or another parameter's range changes no
other quantity. numpy promises the bits of its distributions within a version only.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng
from numpy.typing import NDArray

from straightcomp_ros.stage.description import Factors, StageParameters
from straightcomp_ros.straightness.survey import Survey


class Streams(NamedTuple):
    """Random numbers of one trial, by purpose."""

    machine: Generator
    sensor: Generator
    clock: Generator
    survey: Generator


class Deviation(NamedTuple):
    """One machine: factors of mass, force, air gap and friction; sensor noise in m; command delay in samples; factor of
    the amplifier's bandwidth."""

    mass: float
    force: float
    air_gap: float
    friction: float
    sensor_noise: float
    delay: float
    amplifier: float

    @property
    def factors(self) -> Factors:
        """The machine relative to its description."""
        return Factors(self.mass, self.force, self.air_gap, self.friction, self.amplifier)


def streams(seed: int, trial: int) -> Streams:
    """The random numbers of trial ``trial`` (from 0), as of ``SeedSequence(seed).spawn(n)[trial]`` for any n."""
    children = SeedSequence(seed, spawn_key=(trial,)).spawn(len(Streams._fields))
    return Streams(*map(default_rng, children))


def draw(stage: StageParameters, random: Generator) -> Deviation:
    """A machine within the uncertainty of ``stage``."""
    ranges = stage.uncertainty
    u = random.random(len(Deviation._fields)).tolist()
    return Deviation(
        mass=1.0 + ranges.mass * (2.0 * u[0] - 1.0),
        force=1.0 + ranges.force * (2.0 * u[1] - 1.0),
        air_gap=1.0 + ranges.air_gap * (2.0 * u[2] - 1.0),
        friction=ranges.friction ** (2.0 * u[3] - 1.0),
        sensor_noise=ranges.sensor_noise * stage.encoder.y_resolution * u[4],
        delay=stage.drive.delay * (ranges.shortest_delay + (ranges.longest_delay - ranges.shortest_delay) * u[5]),
        amplifier=ranges.amplifier ** (2.0 * u[6] - 1.0),
    )


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
