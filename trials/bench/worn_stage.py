"""Months of strokes of a simulated stage whose wear is known.

Strokes are simulated on a grid of machines: sound, with more and less friction, with a slower amplifier, with an
encoder of y of another scale. Rows are made of them by the code of `straightcomp history add`, without the truth that
only a simulation knows. A month draws its strokes from these at random, so that figures scatter as they do from stroke
to stroke, and moves them by what the grid says of the day's machine. What a simulation of the machine does not have is
assumed: :class:`Climate`, the latency of a real graph, and a displacement sensor on the slider.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.evaluation import BagEvaluation
from straightcomp_ros.fleet.history.rows import StrokeRow
from straightcomp_ros.fleet.history.strokes_of_bag import Recorded, rows_of
from straightcomp_ros.fleet.maintenance.day_levels import FIGURES, DayLevels, levels_of
from straightcomp_ros.hardware.interface import Hardware
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.node_parameters import Values
from trials.bench.known_wear import ASSUMED, Climate, Machine, Wear

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
_RECORDED = Recorded(stage="simulated", map_checksum="first")
_READING_UM = 0.025
"""Standard deviation of the mean of a bin by the displacement sensor, as of a point of the shipped survey."""


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
        total = np.zeros(next(iter(machine.values())).size)
        for axis, factors in machine.items():
            values = sorted(_AXES[axis])
            means = np.array([self.figure(axis, value, name, forward).mean() for value in values])
            at = np.interp(factors, values, means)
            total += at - means[values.index(1.0)]
        return total


def stroke_pool(starts: int, progress: Callable[[float], None] = lambda fraction: None) -> StrokePool:
    """Simulate ``starts`` cycles of each machine of the grid, each from another place within a count of the encoder."""
    machines = [(axis, value) for axis, values in _AXES.items() for value in values]
    rows = {}
    for number, (axis, value) in enumerate(machines):
        cycles = [_cycle(axis, value, start * _PITCH) for start in range(starts)]
        rows[axis, value] = [row for cycle in cycles for row in cycle]
        progress((number + 1) / len(machines))
    return StrokePool(rows)


class _Scaled:
    """Hardware whose encoder of y has another scale."""

    def __init__(self, factor: float, hardware: Hardware) -> None:
        self._factor, self._hardware = factor, hardware

    def read(self, *arguments: Any) -> Any:
        return [
            (sample._replace(y=self._factor * sample.y), truth) for sample, truth in self._hardware.read(*arguments)
        ]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._hardware, name)


def _cycle(axis: str, value: float, initial_y: float) -> list[StrokeRow]:
    driver: dict[str, Any] = {"simulated.initial_y": initial_y}
    if axis != "scale":
        driver[f"simulated.truth.{axis}"] = value
    wiring: Any = partial(_Scaled, value) if axis == "scale" else None
    return simulated_rows({"driver": driver}, wiring=wiring)


def simulated_rows(
    values: Values,
    recorded: Recorded = _RECORDED,
    readings: Callable[[Array], Array] | None = None,
    wiring: Any = None,
) -> list[StrokeRow]:
    """The rows of a simulated cycle, one forward and one backward, without the truth.

    Args:
        values: parameters by node and dotted name.
        recorded: what the bag would say beside its samples.
        readings: of a displacement sensor on the slider in m, at true x (n,) in m; None without one.
        wiring: between machine and driver.
    """
    coils: list[float] = []
    simulation = Simulation(values, wiring=wiring)
    record = simulation.run(observe=lambda sample, *_: coils.append(sample.current))
    assert record.true_x is not None
    guide = None if readings is None else readings(record.true_x)
    # A real machine does not tell the truth.
    record = replace(record, true_x=None, true_y=None, guide=None)
    stamps = np.round(record.time * 1e9).astype(np.int64)
    evaluation = BagEvaluation(
        record=record,
        expected_samples=stamps.size,
        received_samples=stamps.size,
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
    climate: Climate = ASSUMED,
    bags: int = BAGS_A_DAY,
    sensor: bool = True,
) -> Months:
    """``days`` days of a stage that wears from day ``begin`` on; ``sensor``: with a displacement sensor."""
    random = np.random.default_rng(seed)
    weather = {name: _weather(random, days, size) for name, size in vars(climate).items()}
    machines = [wear.machine(day - begin) if day >= begin else Machine() for day in range(days)]
    of_day = {name: np.array([getattr(one, name) for one in machines]) for name in Machine._fields}
    day = np.repeat(np.arange(days), 2 * bags)
    forward = np.tile([True, False], days * bags)
    starts = len(pool.rows["friction", 1.0]) // 2
    drawn = random.integers(starts, size=day.size)
    figures = {}
    factors = {axis: (of_day[axis] * (1.0 + weather[axis]))[day] for axis in _AXES}
    for name in FIGURES:
        values = np.empty(day.size)
        if name in _LATENCY:
            mean, spread = _LATENCY[name]
            values = mean + spread * random.standard_normal(day.size) + weather[name][day]
            values += _SLOWER[name] * of_day["slower"][day]
        else:
            for way in (True, False):
                ours = forward == way
                base = pool.figure("friction", 1.0, name, way)[drawn[ours]]
                values[ours] = base + pool.moved(name, way, {axis: one[ours] for axis, one in factors.items()})
        figures[name] = values
    x = pool.x
    middle = (x - x.mean()) / np.ptp(x)
    profile = np.outer(weather["bow_um"], 4.0 * middle**2) + np.outer(of_day["settled_um"], settled(x))
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
    return levels_of(strokes.day, strokes.forward, strokes.figures, x, profiles, [strokes.software, constant, constant])


def rows_of_months(pool: StrokePool, strokes: Months, stage: str) -> list[StrokeRow]:
    """These months as rows of a store; a bag has a stroke forward and one backward."""
    rows = []
    per_day = int(np.count_nonzero(strokes.day == strokes.day[0]))
    for k, day in enumerate(strokes.day.tolist()):
        row = _nearest(pool, {axis: float(one[k]) for axis, one in strokes.factors.items()})[
            2 * int(strokes.drawn[k]) + (0 if strokes.forward[k] else 1)
        ]
        within = (k % per_day) * (86_400.0 / per_day)
        started = START + timedelta(days=day - _FIRST_DAY, seconds=within)
        figures = {name: float(values[k]) for name, values in strokes.figures.items()}
        guide = None if np.isnan(strokes.guide[k]).all() else strokes.guide[k].tolist()
        number = k // 2
        rows.append(
            replace(
                row,
                **{**figures, "lost_samples": round(figures["lost_samples"])},
                checksum=f"{number:032x}",
                bag=f"{stage}_{number:05d}",
                start=started,
                guide_change_um=guide,
                software_version=strokes.software[k],
            )
        )
    return rows


def _nearest(pool: StrokePool, machine: Mapping[str, float]) -> list[StrokeRow]:
    """The strokes of the grid's machine that is nearest on the axis on which this one differs most."""
    axis = max(machine, key=lambda one: abs(machine[one] - 1.0))
    return pool.rows[axis, min(_AXES[axis], key=lambda value: abs(value - machine[axis]))]


def _weather(random: np.random.Generator, days: int, size: float, kept: float = 0.8) -> Array:
    from scipy.signal import lfilter

    steps = random.standard_normal(days + 50) * np.sqrt(1.0 - kept**2)
    return size * np.asarray(lfilter([1.0], [1.0, -kept], steps))[50:]


def settled(x: Array) -> Array:
    """A bump of height 1 from x = 300 to 420 mm; ``x`` in m."""
    u = np.clip((x - 0.3) / 0.12, 0.0, 1.0)
    return np.asarray(np.sin(np.pi * u) ** 2)
