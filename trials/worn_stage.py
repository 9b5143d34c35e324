"""Months of strokes of a simulated stage whose wear is known.

Strokes are simulated on a grid of machines: sound, with more and less friction, with a slower amplifier, with an
encoder of y of another scale. Rows are made of them by the code of `straightcomp history add`, without the truth that
only a simulation knows. A month draws its strokes from these at random, so that figures scatter as they do from stroke
to stroke, and moves them by what the grid says of the day's machine. What a simulation of the machine does not have is
assumed: :data:`CLIMATE`, the latency of a real graph, and a displacement sensor on the slider.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from straightcomp_ros.analysis.evaluation import BagEvaluation
from straightcomp_ros.fleet.history.rows import StrokeRow, parquet
from straightcomp_ros.fleet.history.store import STROKES
from straightcomp_ros.fleet.history.strokes_of_bag import rows_of
from straightcomp_ros.fleet.maintenance.day_levels import FIGURES, DayLevels, levels_of
from straightcomp_ros.fleet.maintenance.level_change import MONTH, WEEK
from straightcomp_ros.hardware.interface import Hardware
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.parameters.output_files import write_whole

Array = NDArray[np.float64]
BAGS_A_DAY = 24
START = datetime(2026, 1, 1, tzinfo=timezone.utc)
_FIRST_DAY = int(START.timestamp()) // 86_400
_AXES = {
    "friction": (0.9, 1.0, 1.1, 1.25, 1.4, 1.6, 1.8),
    "amplifier": (1.0, 0.85, 0.7, 0.55, 0.4),
    "scale": (1.0, 1.02, 1.04, 1.06),
}
"""Machines of the grid, relative to the description."""
_PITCH = 0.13e-6
_ADC_STEP = 2.0 / 4096
"""A; measured coil currents are rounded as by 12 bits for ± 1 A. The simulated ones have no other noise."""
_LATENCY = {"latency_p50_us": (122.0, 10.0), "latency_p99_us": (281.0, 24.0)}
"""Mean and standard deviation from run to run of a graph on two shared cores, measured in six runs."""
_SLOWER = {"latency_p50_us": 36.0, "latency_p99_us": 60.0}
"""What another transport of the messages added there, mean of three pairs of runs."""
_RECORDED = {"map_checksum": "first"}
_READING_UM = 0.025
"""Standard deviation of the mean of a bin by the displacement sensor, as of a point of the shipped survey."""


CLIMATE = {
    "friction": 0.02,
    "amplifier": 0.003,
    "scale": 0.003,
    "bow_um": 0.02,
    "latency_p50_us": 3.0,
    "latency_p99_us": 10.0,
}
"""How a sound stage differs from day to day: assumed, not measured. First-order autoregressive, each day 0.8 of the day
before; standard deviations, relative or in the unit named. There are no seasons."""


class Machine(NamedTuple):
    """A day's machine relative to the description: factors, µm at the middle of the guide's moved place, µs."""

    friction: float = 1.0
    amplifier: float = 1.0
    scale: float = 1.0
    settled_um: float = 0.0
    kink_um: float = 0.0
    slower: float = 0.0


class Wear(NamedTuple):
    """A known wear, the causes of advice that are right, and the machine so many days after it began."""

    name: str
    words: str
    causes: tuple[str, ...]
    machine: Callable[[float], Machine]


SOUND = Wear("sound", "sound", (), lambda days: Machine())
WEARS = (
    Wear("friction", "friction +1 % a week", ("friction_up",), lambda days: Machine(friction=1.0 + 0.01 * days / WEEK)),
    Wear("guide", "guide +0.05 µm a month", ("guide",), lambda days: Machine(settled_um=0.05 * days / MONTH)),
    Wear("scale", "scale of y +0.5 % a month", ("stiffness",), lambda days: Machine(scale=1.0 + 0.005 * days / MONTH)),
    Wear(
        "amplifier", "amplifier -1 % a week", ("amplifier",), lambda days: Machine(amplifier=1.0 - 0.01 * days / WEEK)
    ),
    Wear("latency", "latency +36 µs by an update", ("host",), lambda days: Machine(slower=1.0)),
    Wear("bolt", "loose bolt, 0.5 µm", ("bolt",), lambda days: Machine(kink_um=0.5)),
)


@dataclass(frozen=True, eq=False)
class StrokePool:
    """Rows of simulated strokes: by axis and its value, forward and backward in turn."""

    rows: Mapping[tuple[str, float], list[StrokeRow]]

    @property
    def x(self) -> Array:
        """(m,) middles of the bins in m."""
        row = self.rows["friction", 1.0][0]
        return (row.bins_from_mm + 10.0 * (np.arange(len(row.error_bins_um)) + 0.5)) * 1e-3

    def figure(self, axis: str, value: float, name: str, forward: bool) -> Array:
        """A figure of all strokes of a direction of a machine."""
        rows = self.rows[axis, value][0 if forward else 1 :: 2]
        return np.array([getattr(row, name) for row in rows], np.float64)

    def moved(self, name: str, forward: bool, machine: Mapping[str, Array]) -> Array:
        """By how much the mean of a figure differs from the sound machine's; ``machine`` has (N,) of each axis."""
        total: Any = 0.0
        for axis, factors in machine.items():
            values = sorted(_AXES[axis])
            means = np.array([self.figure(axis, value, name, forward).mean() for value in values])
            total = total + np.interp(factors, values, means) - means[values.index(1.0)]
        return np.asarray(total)


def stroke_pool(starts: int, advance: Callable[[float], object] = lambda fraction: None) -> StrokePool:
    """Simulate ``starts`` cycles of each machine of the grid, each from another place within a count of the encoder."""
    machines = [(axis, value) for axis, values in _AXES.items() for value in values]
    rows = {}
    for number, (axis, value) in enumerate(machines):
        truth = {} if axis == "scale" else {f"simulated.truth.{axis}": value}
        wiring = partial(_Scaled, value) if axis == "scale" else None
        starts_at = [{"driver": {**truth, "simulated.initial_y": start * _PITCH}} for start in range(starts)]
        rows[axis, value] = [row for values in starts_at for row in simulated_rows(values, wiring=wiring)]
        advance((number + 1) / len(machines))
    return StrokePool(rows)


class _Scaled:
    """Hardware whose encoder of y has another scale."""

    def __init__(self, factor: float, hardware: Hardware) -> None:
        self._factor, self._hardware = factor, hardware

    def read(self, *arguments: Any) -> Any:
        samples = self._hardware.read(*arguments)
        return [(sample._replace(y=self._factor * sample.y), truth) for sample, truth in samples]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._hardware, name)


def simulated_rows(
    values: Values,
    recorded: Mapping[str, Any] = _RECORDED,
    readings: Callable[[Array], Array] | None = None,
    wiring: Any = None,
) -> list[StrokeRow]:
    """The rows of a simulated cycle, one forward and one backward, without the truth.

    Args:
        values: parameters by node and dotted name.
        recorded: columns of the rows that the bag would state apart from its samples.
        readings: of a displacement sensor on the slider in m, at true x (n,) in m; None without one.
        wiring: between machine and driver.
    """
    coils: list[float] = []
    simulation = Simulation(values, wiring=wiring)
    record = simulation.run(observe=lambda sample, *_: coils.append(sample.current))
    assert record.true_x is not None
    guide = None if readings is None else readings(record.true_x)
    # A real machine does not publish the truth.
    record = replace(record, true_x=None, true_y=None, guide=None)
    stamps = np.round(record.time * 1e9).astype(np.int64)
    evaluation = BagEvaluation(
        record=record,
        lost_references=0,
        lost_commands=0,
        latency=np.empty(0),
        lateness=np.empty(0),
        stamps=stamps,
        amplifier_on=np.ones(stamps.size, np.bool_),
        parameters={},
        map=simulation.map,
        coil_current=np.round(np.array(coils) / _ADC_STEP) * _ADC_STEP,
        guide=guide,
    )
    return rows_of(evaluation, recorded)


class Months(NamedTuple):
    """Strokes in the order of time: day since 1970, direction, figures by name (N,), change of the guide (N, m) in µm,
    software (N,), which stroke of the pool each is made from, and the machine's factors by axis."""

    day: NDArray[np.int64]
    forward: NDArray[np.bool_]
    figures: dict[str, Array]
    guide: Array
    software: list[str]
    drawn: NDArray[np.intp]
    factors: dict[str, Array]


def months(
    pool: StrokePool,
    wear: Wear,
    begin: int,
    days: int,
    seed: int,
    *,
    bags: int = BAGS_A_DAY,
    sensor: bool = True,
) -> Months:
    """``days`` days of a stage that wears from day ``begin`` on; ``sensor``: with a displacement sensor."""
    random = np.random.default_rng(seed)
    daily = {name: _daily(random, days, size) for name, size in CLIMATE.items()}
    machines = [wear.machine(day - begin) if day >= begin else Machine() for day in range(days)]
    of_day = {name: np.array([getattr(one, name) for one in machines]) for name in Machine._fields}
    day = np.repeat(np.arange(days), 2 * bags)
    forward = np.tile([True, False], days * bags)
    starts = len(pool.rows["friction", 1.0]) // 2
    drawn = random.integers(starts, size=day.size)
    figures = {}
    factors = {axis: (of_day[axis] * (1.0 + daily[axis]))[day] for axis in _AXES}
    for name in FIGURES:
        values = np.empty(day.size)
        if name in _LATENCY:
            mean, spread = _LATENCY[name]
            values = mean + spread * random.standard_normal(day.size) + daily[name][day]
            values += _SLOWER[name] * of_day["slower"][day]
        else:
            for way in (True, False):
                ours = forward == way
                base = pool.figure("friction", 1.0, name, way)[drawn[ours]]
                values[ours] = base + pool.moved(name, way, {axis: one[ours] for axis, one in factors.items()})
        figures[name] = values
    x = pool.x
    middle = (x - x.mean()) / np.ptp(x)
    profile = np.outer(daily["bow_um"], 4.0 * middle**2) + np.outer(of_day["settled_um"], settled(x))
    profile += np.outer(of_day["kink_um"], np.maximum(1.0 - np.abs(x - 0.9) / 0.06, 0.0))
    guide = profile[day] + _READING_UM * random.standard_normal((day.size, x.size))
    if not sensor:
        guide[:] = np.nan
    software = ["1.2" if one else "1.1" for one in (of_day["slower"] > 0.0)[day].tolist()]
    return Months(day + _FIRST_DAY, forward, figures, guide, software, drawn, factors)


def levels_of_months(strokes: Months, x: Array) -> DayLevels:
    """The levels of these months, ``x`` (m,) in m."""
    constant = ["first"] * len(strokes.software)
    error = np.full((strokes.day.size, 0), np.nan)
    profiles = {"guide_change_um": strokes.guide, "error_bins_um": np.broadcast_to(np.nan, (error.shape[0], x.size))}
    settings = {"software": strokes.software, "map": constant, "parameters": constant}
    return levels_of(strokes.day, strokes.forward, strokes.figures, x, profiles, settings)


def rows_of_months(pool: StrokePool, strokes: Months, stage: str) -> list[StrokeRow]:
    """These months as rows of a store; a bag has a stroke forward and one backward."""
    rows = []
    per_day = int(np.count_nonzero(strokes.day == strokes.day[0]))
    for k, day in enumerate(strokes.day.tolist()):
        # Of the grid's machine that is nearest on the axis on which this one differs most.
        factors = {axis: float(one[k]) for axis, one in strokes.factors.items()}
        axis = max(factors, key=lambda one: abs(factors[one] - 1.0))
        nearest = min(_AXES[axis], key=lambda value: abs(value - factors[axis]))
        row = pool.rows[axis, nearest][2 * int(strokes.drawn[k]) + (0 if strokes.forward[k] else 1)]
        figures: dict[str, Any] = {name: float(values[k]) for name, values in strokes.figures.items()}
        figures["lost_samples"] = round(figures["lost_samples"])
        facts: dict[str, Any] = {
            "checksum": f"{k // 2:032x}",
            "bag": f"{stage}_{k // 2:05d}",
            "start": START + timedelta(days=day - _FIRST_DAY, seconds=(k % per_day) * (86_400.0 / per_day)),
            "guide_change_um": None if np.isnan(strokes.guide[k]).all() else strokes.guide[k].tolist(),
            "software_version": strokes.software[k],
        }
        rows.append(replace(row, **figures, **facts))
    return rows


def _daily(random: np.random.Generator, days: int, size: float, kept: float = 0.8) -> Array:
    steps = random.standard_normal(days + 50) * np.sqrt(1.0 - kept**2)
    return size * np.asarray(lfilter([1.0], [1.0, -kept], steps))[50:]


def settled(x: Array) -> Array:
    """A bump of height 1 from x = 300 to 420 mm; ``x`` in m."""
    u = np.clip((x - 0.3) / 0.12, 0.0, 1.0)
    return np.asarray(np.sin(np.pi * u) ** 2)


def write_store(
    folder: Path,
    pool: StrokePool,
    advance: Callable[[float], object] = lambda fraction: None,
    *,
    days: int = 365,
    begin: int = 120,
    seed: int = 7,
) -> None:
    """Write ``days`` days of a stage of each wear, and of a sound one; a file for each month. OSError if that fails."""
    stages = (SOUND, *WEARS)
    for number, wear in enumerate(stages):
        strokes = months(
            pool, wear, begin, days, seed + number, bags=4
        )  # fewer than a machine makes: the store is for looking at
        rows = rows_of_months(pool, strokes, wear.name)
        for month, group in groupby(rows, key=lambda row: f"{row.start:%Y-%m}"):
            place = folder / STROKES / f"stage={wear.name}" / f"month={month}"
            place.mkdir(parents=True, exist_ok=True)
            write_whole(place / f"simulated_{month}.parquet", parquet(StrokeRow, list(group)))
        advance((number + 1) / len(stages))
