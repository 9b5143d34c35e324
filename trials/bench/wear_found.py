"""How soon known wear is found with its cause, and how often a sound stage is accused.

Every alarm counts that somebody who reads the advice each day is told: each cause that is due and was not the day
before, the same one again whenever it had lapsed. A year is gone through day by day, with what was known on the day.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.fleet.maintenance.advice import advice_of, changes_of
from straightcomp_ros.fleet.maintenance.day_levels import DayLevels
from trials.bench.known_wear import SOUND, WEARS, Wear
from trials.bench.worn_stage import StrokePool, levels_of_months, months

DAYS = 365
BEGIN = 120
"""Day on which wear begins."""
_OF_THE_GUIDE = {"guide", "bolt"}
"""Causes that only a displacement sensor shows."""


class Alarm(NamedTuple):
    """A cause that was not due the day before: its name, and place of the day."""

    cause: str
    place: int


class Found(NamedTuple):
    """One stage-year: days from the wear's beginning to the alarm with the right cause (None without), and how many
    alarms it raised with another cause, or before the wear began."""

    after: int | None
    others: int


def measure(
    pool: StrokePool, seeds: int, sound: int, progress: Callable[[float], None] = lambda fraction: None
) -> dict[str, Any]:
    """Figures of ``seeds`` stage-years of each wear, and of ``sound`` of a stage without wear."""
    blind = sum(bool(_OF_THE_GUIDE & set(wear.causes)) for wear in WEARS)
    total, done = sound + seeds * (len(WEARS) + blind), 0
    false = []
    for seed in range(sound):
        false.append(len(alarms_of(_levels(pool, SOUND, seed, True))))
        done += 1
        progress(done / total)
    rows = {}
    for number, wear in enumerate(WEARS):
        for sensor in (True, False) if _OF_THE_GUIDE & set(wear.causes) else (True,):
            years = []
            for seed in range(seeds):
                years.append(found(pool, wear, 10_000 * (number + 1) + seed, sensor))
                done += 1
                progress(done / total)
            rows[wear.words if sensor else f"{wear.words}, no sensor"] = _summary(years)
    return {
        "seeds": seeds,
        "sound_years": sound,
        "false_alarms": sum(false),
        "false_a_year": sum(false) / sound,
        "years_with_false": sum(map(bool, false)),
        "most_false_in_a_year": max(false),
        "wears": rows,
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


def _summary(years: list[Found]) -> dict[str, Any]:
    after = [one.after for one in years if one.after is not None]
    return {
        "found": len(after),
        "years": len(years),
        "days_median": float(np.median(after)) if after else None,
        "days_least": min(after, default=None),
        "days_most": max(after, default=None),
        "other_alarms": sum(one.others for one in years),
    }
