"""Measure how soon known wear of a simulated stage is found with its cause, how often a sound stage is accused, and how
good a map is that is proposed from strokes.

Stage-years are drawn from simulated strokes; docs/evidence/history.md says how and what is assumed. An alarm is a cause
that is due and was not the day before, the same one again whenever it had lapsed: a year is gone through day by day,
with what was known on the day."""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.cli.options import check_range, output_folder
from straightcomp_ros.cli.output import print_json
from straightcomp_ros.fleet.history.rows import StrokeRow, checksum_of, table_of
from straightcomp_ros.fleet.maintenance.advice import advice_of, changes_of
from straightcomp_ros.fleet.maintenance.day_levels import DayLevels
from straightcomp_ros.fleet.maintenance.map_proposal import proposed_map
from straightcomp_ros.offline.starts import runs_of_starts, spread
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey, load_map
from straightcomp_ros.straightness.survey import Run, Survey, read_survey, write_survey
from straightcomp_ros.tuning.sweep.trial import mismeasured
from trials.rig import Progress, progress
from trials.worn_stage import (
    SOUND,
    WEARS,
    StrokePool,
    Wear,
    levels_of_months,
    months,
    settled,
    simulated_rows,
    stroke_pool,
    write_store,
)

SUMMARY = "how soon wear is found, and by how many false alarms"
DAYS, BEGIN = 365, 120
"""Days of a stage-year, and the day on which wear begins."""
CYCLES = 24
"""From which a map is proposed, forward and backward: a day with a bag an hour."""
_STARTS = 8
_OF_THE_GUIDE = {"guide", "bolt"}
"""Causes that only a displacement sensor shows."""
_SURVEY_NOISE = 0.025e-6
"""m; of a point of a survey, as of the shipped one."""
_READING_NOISE = 0.2e-6
"""m; of a single reading on a stroke: its bins of 10 mm, 66 samples at 0.3 m/s, are then as good as points."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--years", type=int, default=10, metavar="N", help="stage-years of each wear (default: %(default)s)")
    add("--sound", type=int, default=50, metavar="N", help="stage-years without wear (default: %(default)s)")
    add("--moved", type=float, default=0.5, metavar="UM", help="how far the guide moved, for the map (default: 0.5)")
    add("--store", metavar="DIR", help="also write a store with a year of each wear, to try the other verbs on")


def run(options: argparse.Namespace) -> None:
    check_range("--years", options.years, 1, 10_000)
    check_range("--sound", options.sound, 1, 10_000)
    check_range("--moved", options.moved, 0.0, 50.0, "µm")
    store = output_folder("--store", options.store, empty=True) if options.store else None
    with progress() as advance, tempfile.TemporaryDirectory(prefix="straightcomp_wear_") as folder:
        pool = stroke_pool(_STARTS, lambda done: advance("strokes of the machines", done))
        if store is not None:
            write_store(store, pool, lambda done: advance("store", done))
        figures = measured(pool, options.years, options.sound, advance)
        figures["map"] = followed_map(Path(folder), options.moved, advance=advance)
    print_json(figures)


class Alarm(NamedTuple):
    """A cause that was not due the day before: its name, and place of the day."""

    cause: str
    place: int


class Found(NamedTuple):
    """One stage-year: days from the wear's beginning to the alarm with the right cause (None without), and how many
    alarms it raised with another cause, or before the wear began."""

    after: int | None
    others: int


def measured(pool: StrokePool, seeds: int, sound: int, advance: Progress = lambda text, done: None) -> dict[str, Any]:
    """Figures of ``seeds`` stage-years of each wear, and of ``sound`` of a stage without wear."""
    false = []
    for seed in range(sound):
        advance("sound stage-years", seed / sound)
        false.append(len(alarms_of(_levels(pool, SOUND, seed, True))))
    wears = {}
    for number, wear in enumerate(WEARS):
        for sensor in (True, False) if _OF_THE_GUIDE & set(wear.causes) else (True,):
            advance(wear.words, number / len(WEARS))
            years = [found(pool, wear, 10_000 * (number + 1) + seed, sensor) for seed in range(seeds)]
            after = [one.after for one in years if one.after is not None]
            wears[wear.words if sensor else f"{wear.words}, no sensor"] = {
                "found": len(after),
                "years": seeds,
                "days_median": float(np.median(after)) if after else None,
                "days_least": min(after, default=None),
                "days_most": max(after, default=None),
                "other_alarms": sum(one.others for one in years),
            }
    return {
        "sound_years": sound,
        "false_alarms": sum(false),
        "false_a_year": sum(false) / sound,
        "years_with_false": sum(map(bool, false)),
        "most_false_in_a_year": max(false),
        "wears": wears,
    }


def alarms_of(levels: DayLevels) -> list[Alarm]:
    """The alarms that these months raised, in the order of time."""
    changes = changes_of(levels)
    alarms, due = [], set[str]()
    # Which figure stands for the cause depends on how much each has changed so far: that may change on any day.
    for day in range(min((change.found for change in changes), default=len(levels.day)), len(levels.day)):
        standing = any(change.found <= day and (change.ended is None or day < change.ended) for change in changes)
        before = due
        due = {one.cause for one in advice_of(levels.until(day + 1)) if one.due} if standing else set()
        alarms += [Alarm(cause, day) for cause in sorted(due - before)]
    return alarms


def found(pool: StrokePool, wear: Wear, seed: int, sensor: bool) -> Found:
    """One stage-year of a wear."""
    alarms = alarms_of(_levels(pool, wear, seed, sensor))
    right = [alarm.place for alarm in alarms if alarm.cause in wear.causes and alarm.place >= BEGIN]
    return Found(min(right) - BEGIN if right else None, len(alarms) - len(right))


def _levels(pool: StrokePool, wear: Wear, seed: int, sensor: bool) -> DayLevels:
    return levels_of_months(months(pool, wear, BEGIN, DAYS, seed, sensor=sensor), pool.x)


def followed_map(
    folder: Path, moved_um: float, seed: int = 0, cycles: int = CYCLES, advance: Progress = lambda text, done: None
) -> dict[str, Any]:
    """Straightness of the simulated workpiece in µm, p-p, median of nine starts, on a guide that has moved.

    With the old map, with one that is proposed from strokes, and with one of a fresh survey.

    Args:
        folder: for the surveys.
        moved_um: height in µm of the bump that the guide has got from x = 300 to 420 mm.
        seed: of the noise.
        cycles: from which the map is proposed, each forward and backward.
        advance: called with the fraction that is done.
    """
    random = np.random.default_rng(seed)
    old, guide = (find_survey(f"config/{name}_synthetic.csv") for name in ("survey", "guide"))
    ideal = read_survey(guide).runs[0]
    moved = replace(ideal, deviation=ideal.deviation + moved_um * 1e-6 * settled(ideal.x))
    true, fresh, proposed = (folder / f"{name}.csv" for name in ("moved_guide", "fresh_survey", "proposed_map"))
    write_survey(true, Survey((moved,), str(true)), ["the simulated guide, moved"])
    runs = [Run(str(n), way, moved.x, moved.deviation) for n in (1, 2, 3) for way in ("forward", "backward")]
    write_survey(fresh, mismeasured(Survey(tuple(runs), str(fresh)), _SURVEY_NOISE, random), ["survey of that guide"])
    # Of the written file: the moved guide as the simulated machine has it.
    truth = load_map(MapParameters(file=str(true)))
    recorded = {"map_checksum": checksum_of([old.read_bytes()])}
    rows: list[StrokeRow] = []
    for cycle in range(cycles):
        advance("strokes for the map", 0.5 * cycle / cycles)
        driver = {"simulated.truth.guide": str(true), "simulated.initial_y": 0.13e-6 * cycle}
        rows += simulated_rows(
            {"driver": driver},
            recorded,
            lambda x: truth.deviations(x) + _READING_NOISE * random.standard_normal(x.size),
        )
    proposal = proposed_map(table_of(StrokeRow, rows), old, 1.0)
    proposal.built.write(proposed)
    figures: dict[str, Any] = {"moved_um": moved_um, "strokes": proposal.strokes}
    for place, (name, file) in enumerate({"old": old, "proposed": proposed, "fresh": fresh}.items()):
        advance(f"strokes with the {name} map", 0.5 + place / 6)
        values = {"driver": {"simulated.truth.guide": str(true)}}
        values |= {node: {"stage.guide.file": str(file)} for node in ("feedforward", "controller")}
        figures[f"{name}_um"] = spread(evaluate(*one).residual_pp * 1e6 for one in runs_of_starts(values))._asdict()
    figures["proposed_to_fresh"] = figures["proposed_um"]["median"] / figures["fresh_um"]["median"]
    return figures
