"""A store of simulated stages whose wear is known, to try reports and advice on."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path

from straightcomp_ros.fleet.history.rows import StrokeRow, parquet
from straightcomp_ros.fleet.history.store import STROKES
from straightcomp_ros.parameters.whole_file import write_whole
from trials.bench.known_wear import SOUND, WEARS
from trials.bench.worn_stage import StrokePool, months, rows_of_months

_BAGS_A_DAY = 4
"""Fewer than a machine makes: the store is for looking at."""


def write_store(
    folder: Path,
    pool: StrokePool,
    progress: Callable[[float], None] = lambda fraction: None,
    *,
    days: int = 365,
    begin: int = 120,
    seed: int = 7,
) -> None:
    """Write ``days`` days of a stage of each wear, and of a sound one; a file for each month. OSError if that fails."""
    stages = (SOUND, *WEARS)
    for number, wear in enumerate(stages):
        strokes = months(pool, wear, begin, days, seed + number, bags=_BAGS_A_DAY)
        rows = rows_of_months(pool, strokes, wear.name)
        for month, group in groupby(rows, key=lambda row: f"{row.start:%Y-%m}"):
            place = folder / STROKES / f"stage={wear.name}" / f"month={month}"
            place.mkdir(parents=True, exist_ok=True)
            write_whole(place / f"simulated_{month}.parquet", parquet(StrokeRow, list(group)))
        progress((number + 1) / len(stages))
