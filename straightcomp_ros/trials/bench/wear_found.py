"""How soon known wear is found, how often its cause is named, and how often a sound stage is accused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from straightcomp_ros.maintenance.advice import Advice, advice_of
from straightcomp_ros.maintenance.day_levels import DayLevels
from straightcomp_ros.trials.bench.known_wear import SOUND, WEARS, Wear
from straightcomp_ros.trials.bench.worn_stage import StrokePool, levels_of_months, months

DAYS = 365
BEGIN = 120
"""Day on which wear begins."""
_OF_THE_GUIDE = {"guide", "bolt"}
"""Causes that only a displacement sensor shows."""


class Found(NamedTuple):
    """One stage-year: days from the wear's beginning to the advice with the right cause (None without), whether that
    cause was named on the very day, and pieces of other advice in the year."""

    after: int | None
    named: bool
    others: int


def measure(
    pool: StrokePool, seeds: int, sound: int, progress: Callable[[float], None] = lambda fraction: None
) -> dict[str, Any]:
    """Figures of ``seeds`` stage-years of each wear, and of ``sound`` of a stage without wear."""
    blind = sum(bool(_OF_THE_GUIDE & set(wear.causes)) for wear in WEARS)
    total, done = sound + seeds * (len(WEARS) + blind), 0
    false = []
    for seed in range(sound):
        false.append(len(advice_of(_levels(pool, SOUND, seed, True))))
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
        "false_a_year": sum(false) / sound,
        "years_with_false": sum(map(bool, false)),
        "wears": rows,
    }


def found(pool: StrokePool, wear: Wear, seed: int, sensor: bool) -> Found:
    """One stage-year of a wear."""
    levels = _levels(pool, wear, seed, sensor)
    first_day = int(levels.day[0])
    advice = advice_of(levels)
    right = [place for one in advice if one.cause in wear.causes and (place := _day(one) - first_day) >= BEGIN]
    others = len(advice) - len(right)
    if not right:
        return Found(None, False, others)
    at = min(right)
    named = any(one.cause in wear.causes for one in advice_of(levels.until(at + 1)))
    return Found(at - BEGIN, named, others)


def _day(advice: Advice) -> int:
    return int(np.datetime64(advice.found, "D").astype(int))


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
        "named_at_once": sum(one.named for one in years),
        "other_advice": sum(one.others for one in years),
    }
