"""Measure how soon known wear of a simulated stage is found with its cause, how often a sound stage is accused, and how
good a map is that is proposed from strokes.

Strokes are simulated on a grid of machines: sound, with more and less friction, with a slower amplifier, with an
encoder of y of another scale. Rows are made of them by the code of `straightcomp history add`, without the truth that
only a simulation knows. A stage-year draws its strokes from these at random, and moves their figures by what the grid
says of the day's machine. What a simulation does not have is assumed: :data:`CLIMATE`, the latency of a real graph, and
a displacement sensor on the slider; docs/evidence/history.md says more.

An alarm is a cause that is due and was not the day before, the same one again whenever it had lapsed: a year is gone
through day by day, with what was known on the day."""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow
from scipy.signal import lfilter

from straightcomp_ros.analysis.evaluation import BagEvaluation
from straightcomp_ros.analysis.interruption import encoder_run
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.record import Array
from straightcomp_ros.cli.options import in_range, output_folder
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.fleet.history.rows import StrokeRow, checksum_of, schema_of, sealed, table_of
from straightcomp_ros.fleet.history.store import STROKES
from straightcomp_ros.fleet.history.strokes_of_bag import rows_of
from straightcomp_ros.fleet.maintenance.advice import advice_of, changes_of
from straightcomp_ros.fleet.maintenance.day_levels import FIGURES, DayLevels, day_levels
from straightcomp_ros.fleet.maintenance.level_change import MONTH, WEEK
from straightcomp_ros.fleet.maintenance.map_proposal import proposed_map
from straightcomp_ros.hardware.simulated import SimulatedHardware
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.starts import PITCH, compiled_cycle, runs_of_starts, spread
from straightcomp_ros.parameters.node_parameters import Values
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.tuning.sweep.trial import mismeasured
from trials.rig import tracked

SUMMARY = "how soon wear is found, and by how many false alarms"
BAGS_A_DAY = 24
START = np.datetime64("2026-01-01", "us")
DAYS, BEGIN = 365, 120
"""Days of a stage-year, and the day on which wear begins."""
_STARTS = 8
_AXES = {
    "friction": (0.9, 1.0, 1.1, 1.25, 1.4, 1.6, 1.8),
    "amplifier": (1.0, 0.85, 0.7, 0.55, 0.4),
    "scale": (1.0, 1.02, 1.04, 1.06),
}
"""Machines of the grid, relative to the description."""
BASE = ("friction", 1.0)
"""That of the grid which is as described."""
_ADC_STEP = 2.0 / 4096
"""A; measured coil currents are rounded as by 12 bits for ± 1 A. The simulated ones have no other noise."""
_LATENCY = {"latency_p50_us": (122.0, 10.0, 36.0), "latency_p99_us": (281.0, 24.0, 60.0)}
"""Mean and standard deviation from run to run of a graph on two shared cores, measured in six runs; and what another
transport of the messages added there, mean of three pairs of runs."""
_READING_UM = 0.025
"""Standard deviation of the mean of a bin by the displacement sensor, as of a point of the shipped survey."""
_OF_THE_GUIDE = {"guide", "bolt"}
"""Causes that only that sensor shows."""
_READING_NOISE = 0.2e-6
"""m; of a single reading on a stroke: its bins of 10 mm, 66 samples at 0.3 m/s, are then as good as points."""

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


class Wear(NamedTuple):
    """A known wear: the cause of advice that is right, and what changes by how much, at once and a day. That is a
    factor of the machine, less 1, relative to the description, or µm of the guide in the middle of a moved place or at
    a loose bolt, or whether messages have another transport."""

    name: str
    words: str
    cause: str
    changes: str
    at_once: float = 0.0
    a_day: float = 0.0


SOUND = Wear("sound", "sound", "", "friction")
WEARS = (
    Wear("friction", "friction +1 % a week", "friction_up", "friction", a_day=0.01 / WEEK),
    Wear("guide", "guide +0.05 µm a month", "guide", "settled_um", a_day=0.05 / MONTH),
    Wear("scale", "scale of y +0.5 % a month", "stiffness", "scale", a_day=0.005 / MONTH),
    Wear("amplifier", "amplifier -1 % a week", "amplifier", "amplifier", a_day=-0.01 / WEEK),
    Wear("latency", "latency +36 µs by an update", "host", "transport", at_once=1.0),
    Wear("bolt", "loose bolt, 0.5 µm", "bolt", "kink_um", at_once=0.5),
)
Pool = Mapping[tuple[str, float], list[StrokeRow]]
"""Rows of simulated strokes: by axis of the grid and its value, forward and backward in turn."""


def stroke_pool(starts: int) -> Pool:
    """Simulate ``starts`` cycles of each machine of the grid, each from another place within a count of the encoder."""
    rows = defaultdict[tuple[str, float], list[StrokeRow]](list)
    for axis, value in tracked([(axis, value) for axis, values in _AXES.items() for value in values], "strokes"):
        truth = {} if axis == "scale" else {f"simulated.truth.{axis}": value}
        for start in range(starts):
            values = {"driver": {**truth, "simulated.initial_y": start * PITCH}}
            rows[axis, value] += simulated_rows(values, scale=value if axis == "scale" else 1.0)
    return rows


def _scaled(factor: float, hardware: SimulatedHardware) -> SimulatedHardware:
    """With another scale of the encoder of y."""
    read = hardware.read
    hardware.read = lambda now_ns: [(one._replace(y=factor * one.y), truth) for one, truth in read(now_ns)]  # type: ignore[method-assign]
    return hardware


def simulated_rows(
    values: Values, checksum: str = "first", readings: Callable[[Array], Array] | None = None, scale: float = 1.0
) -> list[StrokeRow]:
    """The rows of a simulated cycle, one forward and one backward, without the truth.

    Args:
        values: parameters by node and dotted name.
        checksum: of the map.
        readings: of a displacement sensor on the slider in m, at true x (n,) in m; None without one.
        scale: of the encoder of y; the compiled loop has none.
    """
    if scale == 1.0:
        scenario, stroke, cycle = compiled_cycle(values)
        straightness, coils, (law,) = stroke.map, cycle.coil_current, scenario.controls
        record = stroke.record(stroke.stamps * 1e-9, cycle, np.zeros_like(stroke.x), law)
    else:
        simulation, measured = Simulation(values, wiring=partial(_scaled, scale)), list[float]()
        record = simulation.run(observe=lambda sample, *_: measured.append(sample.current))
        straightness, coils = simulation.map, np.array(measured)
    assert record.true_x is not None
    stamps = np.round(record.time * 1e9).astype(np.int64)
    on = np.ones(stamps.size, np.bool_)
    evaluation = BagEvaluation(
        # A real machine does not publish the truth.
        record=replace(record, true_x=None, true_y=None, guide=None),
        lost_references=0,
        lost_commands=0,
        latency=np.empty(0),
        lateness=np.empty(0),
        stamps=stamps,
        amplifier_on=on,
        parameters={},
        encoder=encoder_run(stamps, record.x, on, int(stamps[-1])),
        map=straightness,
        coil_current=np.round(coils / _ADC_STEP) * _ADC_STEP,
        guide=None if readings is None else readings(record.true_x),
    )
    return rows_of(evaluation, {"map_checksum": checksum})


def months(
    pool: Pool, wear: Wear, begin: int, days: int, seed: int, *, bags: int = BAGS_A_DAY, sensor: bool = True
) -> pyarrow.Table:
    """The strokes of ``days`` days of a stage that wears from day ``begin`` on, in the order of time: rows of a store
    whose figures and guide are as float64. ``sensor``: with a displacement sensor."""
    random, base = np.random.default_rng(seed), pool[BASE]
    daily = {name: _daily(random, days, size) for name, size in CLIMATE.items()}
    worn = np.maximum(np.arange(days) - begin, -1)
    changed = defaultdict[str, Array](lambda: np.zeros(days))
    changed[wear.changes] = np.where(worn < 0, 0.0, wear.at_once + wear.a_day * worn)
    day = np.repeat(np.arange(days), 2 * bags)
    forward = np.tile([True, False], days * bags)
    drawn = random.integers(len(base) // 2, size=day.size)
    factors = {axis: ((1.0 + changed[axis]) * (1.0 + daily[axis]))[day] for axis in _AXES}
    figures = {}
    for name in FIGURES:
        values = figures[name] = np.empty(day.size)
        if name in _LATENCY:
            mean, deviation, slower = _LATENCY[name]
            values[:] = mean + deviation * random.standard_normal(day.size)
            values += daily[name][day] + slower * changed["transport"][day]
            continue
        for way in (True, False):
            ours = forward == way
            values[ours] = _figure(base, name, way)[drawn[ours]]
            for axis, choices in _AXES.items():
                grid = sorted(choices)
                means = np.array([_figure(pool[axis, value], name, way).mean() for value in grid])
                values[ours] += np.interp(factors[axis][ours], grid, means) - means[grid.index(1.0)]
    x = (base[0].bins_from_mm + 10.0 * (np.arange(len(base[0].error_bins_um)) + 0.5)) * 1e-3
    middle = (x - x.mean()) / np.ptp(x)
    profile = np.outer(daily["bow_um"], 4.0 * middle**2) + np.outer(changed["settled_um"], settled(x))
    profile += np.outer(changed["kink_um"], np.maximum(1.0 - np.abs(x - 0.9) / 0.06, 0.0))
    guide = profile[day] + _READING_UM * random.standard_normal((day.size, x.size))
    if not sensor:
        guide[:] = np.nan
    number, apart_us = np.arange(day.size), 86_400_000_000 // (2 * bags)
    start = START + (86_400_000_000 * day + apart_us * (number % (2 * bags))).astype("timedelta64[us]")
    columns = {
        **figures,
        "lost_samples": np.round(figures["lost_samples"]),
        "start": pyarrow.array(start, pyarrow.timestamp("us", tz="UTC")),
        "bag": [f"{wear.name}_{k // 2:05d}" for k in number],
        "checksum": [f"{k // 2:032x}" for k in number],
        "software_version": np.where(changed["transport"] > 0.0, "1.2", "1.1")[day],
        "guide_change_um": pyarrow.ListArray.from_arrays(x.size * np.arange(day.size + 1), guide.ravel()),
    }
    table = table_of(StrokeRow, base).take(2 * drawn + number % 2)
    for name, values in columns.items():
        table = table.set_column(table.schema.get_field_index(name), name, pyarrow.array(values))
    return table


def _figure(rows: list[StrokeRow], name: str, forward: bool) -> Array:
    return np.array([getattr(row, name) for row in rows[0 if forward else 1 :: 2]], np.float64)


def _daily(random: np.random.Generator, days: int, size: float, kept: float = 0.8) -> Array:
    steps = random.standard_normal(days + 50) * np.sqrt(1.0 - kept**2)
    return size * np.asarray(lfilter([1.0], [1.0, -kept], steps))[50:]


def settled(x: Array) -> Array:
    """A bump of height 1 from x = 300 to 420 mm; ``x`` in m."""
    u = np.clip((x - 0.3) / 0.12, 0.0, 1.0)
    return np.asarray(np.sin(np.pi * u) ** 2)


def write_store(folder: Path, pool: Pool, *, days: int = DAYS, begin: int = BEGIN) -> None:
    """Write ``days`` days of a stage of each wear, and of a sound one; a file for each month. OSError if that fails."""
    for number, wear in enumerate(tracked((SOUND, *WEARS), "store")):
        # Fewer bags than a machine makes: the store is for looking at.
        table = months(pool, wear, begin, days, 7 + number, bags=4).cast(schema_of(StrokeRow))
        month_of = table["start"].to_numpy().astype("datetime64[M]")
        for month in np.unique(month_of):
            place = folder / STROKES / f"stage={wear.name}" / f"month={month}"
            place.mkdir(parents=True, exist_ok=True)
            strokes = sealed(table.filter(month_of == month), use_dictionary=False, write_statistics=False)
            write_whole(place / f"simulated_{month}.parquet", strokes)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, count = parser.add_argument, in_range(int, 1)
    add("--years", type=count, default=10, metavar="N", help="stage-years of each wear (default: %(default)s)")
    add("--sound", type=count, default=50, metavar="N", help="stage-years without wear (default: %(default)s)")
    add("--store", metavar="DIR", help="also write a store with a year of each wear, to try the other verbs on")


def run(options: argparse.Namespace) -> None:
    store = output_folder("--store", options.store, empty=True) if options.store else None
    pool = stroke_pool(_STARTS)
    if store is not None:
        write_store(store, pool)
    figures = measured(pool, options.years, options.sound)
    with tempfile.TemporaryDirectory(prefix="straightcomp_wear_") as folder:
        figures["map"] = followed_map(Path(folder))
    print_json(figures)


def measured(pool: Pool, years: int, sound: int) -> dict[str, Any]:
    """Figures of so many stage-years of each wear, and of ``sound`` ones without wear."""

    def year(wear: Wear, seed: int, sensor: bool = True) -> list[tuple[str, int]]:
        return alarms_of(day_levels(months(pool, wear, BEGIN, DAYS, seed, sensor=sensor)))

    false = [len(year(SOUND, seed)) for seed in tracked(range(sound), "sound stage-years")]
    wears = {}
    for number, wear in enumerate(tracked(WEARS, "wear"), 1):
        for sensor in (True, False) if wear.cause in _OF_THE_GUIDE else (True,):
            found = [judged(year(wear, 10_000 * number + seed, sensor), wear.cause) for seed in range(years)]
            after = [days for days, _ in found if days is not None]
            wears[wear.words if sensor else f"{wear.words}, no sensor"] = {
                "found": len(after),
                "years": years,
                "days": spread(after)._asdict() if after else None,
                "other_alarms": sum(others for _, others in found),
            }
    return {
        "sound_years": sound,
        "false_alarms": sum(false),
        "false_a_year": sum(false) / sound,
        "years_with_false": sum(map(bool, false)),
        "most_false_in_a_year": max(false),
        "wears": wears,
    }


def alarms_of(levels: DayLevels) -> list[tuple[str, int]]:
    """Cause and place of the day of each alarm that these months raised, in the order of time."""
    changes = changes_of(levels)
    alarms, due = [], set[str]()
    # Which figure stands for the cause depends on how much each has changed so far: that may change on any day.
    for day in range(min((change.found for change in changes), default=len(levels.day)), len(levels.day)):
        standing = any(change.found <= day and (change.ended is None or day < change.ended) for change in changes)
        before = due
        due = {one.cause for one in advice_of(_until(levels, day + 1)) if one.due} if standing else set()
        alarms += [(cause, day) for cause in sorted(due - before)]
    return alarms


def _until(levels: DayLevels, count: int) -> DayLevels:
    """The first ``count`` entries: what was known then."""
    columns, profiles = ({name: one[:count] for name, one in of.items()} for of in (levels.columns, levels.profiles))
    settings = {name: one[:count] for name, one in levels.settings.items()}
    return DayLevels(levels.day[:count], columns, levels.x, profiles, settings)


def judged(alarms: list[tuple[str, int]], cause: str) -> tuple[int | None, int]:
    """Days from the wear's beginning to the alarm with the right cause (None without), and how many alarms there were
    with another cause, or before the wear began."""
    right = [day - BEGIN for name, day in alarms if name == cause and day >= BEGIN]
    return min(right, default=None), len(alarms) - len(right)


def followed_map(folder: Path, moved_um: float = 0.5, cycles: int = 24) -> dict[str, Any]:
    """Straightness of the simulated workpiece in µm, p-p, median of nine starts, on a guide that has got a bump of
    ``moved_um`` in height: with the old map, with one that is proposed from so many cycles, each forward and backward,
    and with one of a fresh survey. ``folder`` gets the surveys."""
    random = np.random.default_rng(0)
    old, guide = (find_survey(f"config/{name}_synthetic.csv") for name in ("survey", "guide"))
    ideal = read_survey(guide).runs[0]
    moved = replace(ideal, deviation=ideal.deviation + moved_um * 1e-6 * settled(ideal.x))
    true, fresh, proposed = (folder / f"{name}.csv" for name in ("moved_guide", "fresh_survey", "proposed_map"))
    write_survey(true, Survey((moved,), str(true)), ["the simulated guide, moved"])
    runs = [Run(str(n), way, moved.x, moved.deviation) for n in (1, 2, 3) for way in ("forward", "backward")]
    survey = mismeasured(Survey(tuple(runs), str(fresh)), _READING_UM * 1e-6, random)
    write_survey(fresh, survey, ["survey of that guide"])
    # Of the written file: the moved guide as the simulated machine has it.
    truth, machine = load_map(MapParameters(file=str(true))), {"simulated.truth.guide": str(true)}
    rows: list[StrokeRow] = []
    for cycle in tracked(range(cycles), "strokes for the map"):
        rows += simulated_rows(
            {"driver": machine | {"simulated.initial_y": PITCH * cycle}},
            checksum_of([old.read_bytes()]),
            lambda x: truth.deviations(x) + _READING_NOISE * random.standard_normal(x.size),
        )
    proposal = proposed_map(table_of(StrokeRow, rows), old, 1.0)
    proposal.built.write(proposed)
    figures: dict[str, Any] = {"moved_um": moved_um, "strokes": proposal.strokes}
    for name, file in tracked({"old": old, "proposed": proposed, "fresh": fresh}.items(), "strokes by the maps"):
        values: Values = {node: {"stage.guide.file": str(file)} for node in ("feedforward", "controller")}
        values = {**values, "driver": machine}
        figures[f"{name}_um"] = spread(evaluate(*one).residual_pp * 1e6 for one in runs_of_starts(values))._asdict()
    figures["proposed_to_fresh"] = figures["proposed_um"]["median"] / figures["fresh_um"]["median"]
    return figures
