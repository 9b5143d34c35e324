"""The figures of a stage that are watched for wear, and their levels from day to day.

A level is a median, which single strokes that went wrong do not move.

The two directions of motion differ, so that each has its median, and their mean is the level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.fleet.history.rows import BIN_MM

if TYPE_CHECKING:
    import pyarrow

Array = NDArray[np.float64]


class Watched(NamedTuple):
    """A figure.

    Attributes:
        name: column of the store; :data:`GUIDE` is made from ``guide_change_um``.
        words: for people.
        unit: of its values.
        relative, absolute: least scatter from day to day that is assumed, as a fraction of the level and in the unit: a
            figure that hardly scatters during its baseline must not make an alarm of every tremor.
        falling: whether a fall is watched too; of the others only a rise is bad.
    """

    name: str
    words: str
    unit: str
    relative: float = 0.002
    absolute: float = 0.0
    falling: bool = False


GUIDE = "guide_change_pp_um"
"""Change of the guide's profile since the baseline, p-p about a line, by the displacement sensor."""
FRICTION, STIFFNESS, AMPLIFIER = "friction_A", "stiffness_A_per_m", "amplifier_bandwidth_Hz"
LATENCY, LATE, LOST = "latency_p50_us", "latency_p99_us", "lost_samples"
ERROR, ERROR_PP, WORK, ACTIVITY = "encoder_rms_um", "encoder_pp_um", "coil_work_A2s", "control_activity_A"

WATCHED = (
    Watched(GUIDE, "change of the guide", "µm", absolute=0.002),
    Watched(FRICTION, "friction", "A", falling=True),
    Watched(STIFFNESS, "stiffness", "A/m", falling=True),
    Watched(AMPLIFIER, "bandwidth of the amplifier", "Hz", falling=True),
    Watched(LATENCY, "latency, median", "µs", absolute=1.0),
    Watched(LATE, "latency, 99th percentile", "µs", absolute=5.0),
    Watched(LOST, "lost samples in a stroke", "", absolute=1.0),
    Watched(ERROR, "error, RMS", "µm"),
    Watched(ERROR_PP, "error, p-p", "µm"),
    Watched(WORK, "work of the coils", "A²s", falling=True),
    Watched(ACTIVITY, "activity of the command", "A"),
)
BY_NAME = {one.name: one for one in WATCHED}
_EPOCH = date(1970, 1, 1)
_GUIDE = "guide_change_um"
PROFILES = (_GUIDE, "error_bins_um")
"""Columns of the store over x that are watched or shown."""
FIGURES = tuple(one.name for one in WATCHED if one.name != GUIDE)
COLUMNS = (
    "start",
    "direction",
    "bins_from_mm",
    *FIGURES,
    *PROFILES,
    "software_version",
    "map_checksum",
    "parameters_checksum",
)
"""Columns of the store that :func:`day_levels` reads."""


@dataclass(frozen=True, eq=False)
class DayLevels:
    """One entry for each day with strokes, in order.

    Attributes:
        day: (n,) days since 1970-01-01.
        strokes: (n,) how many.
        figures: by name, (n,) median of the day; NaN where no stroke has it.
        x: (m,) m, middles of the bins.
        profiles: by name of :data:`PROFILES`, (n, m) median of the day in µm; NaN where not known. That of the guide is
            known of the strokes with the last map alone: another map is another zero.
        software, map, parameters: (n,) of the last stroke of the day, empty where unknown.
    """

    day: NDArray[np.int64]
    strokes: NDArray[np.int64]
    figures: Mapping[str, Array]
    x: Array
    profiles: Mapping[str, Array]
    software: tuple[str, ...]
    map: tuple[str, ...]
    parameters: tuple[str, ...]

    def date(self, place: int) -> date:
        """Date of entry ``place``."""
        return _EPOCH + timedelta(days=int(self.day[place]))

    def until(self, count: int) -> DayLevels:
        """The first ``count`` entries: what was known then."""
        profiles = {name: values[:count] for name, values in self.profiles.items()}
        figures = {name: values[:count] for name, values in self.figures.items()}
        columns = (self.software[:count], self.map[:count], self.parameters[:count])
        return DayLevels(self.day[:count], self.strokes[:count], figures, self.x, profiles, *columns)


def day_levels(strokes: pyarrow.Table) -> DayLevels:
    """The levels from the strokes of a stage in the order of their start, with at least :data:`COLUMNS`."""
    day = np.array([(start.date() - _EPOCH).days for start in strokes["start"].to_pylist()], np.int64)
    columns = {name: _floats(strokes[name].to_pylist()) for name in FIGURES}
    begins = strokes["bins_from_mm"].to_pylist()
    lists = {name: strokes[name].to_pylist() for name in PROFILES}
    x, profiles = _on_one_grid(begins, lists)
    words = [[value or "" for value in strokes[name].to_pylist()] for name in COLUMNS[-3:]]
    forward = np.array([value == "forward" for value in strokes["direction"].to_pylist()], np.bool_)
    return levels_of(day, forward, columns, x, profiles, words)


def levels_of(
    day: NDArray[np.int64],
    forward: NDArray[np.bool_],
    columns: Mapping[str, Array],
    x: Array,
    profiles: Mapping[str, Array],
    words: Sequence[Sequence[str]],
) -> DayLevels:
    """The levels of strokes by columns: ``day``, ``forward`` and ``columns`` (N,), ``profiles`` (N, m) over ``x`` (m,);
    ``words`` are software, map and parameters of each stroke, in the order of time."""
    days, first, counts = np.unique(day, return_index=True, return_counts=True)
    slices = [slice(int(a), int(a + n)) for a, n in zip(first, counts, strict=True)]
    last = (first + counts - 1).tolist()
    software, guide_map, parameters = (tuple(one[place] for place in last) for one in words)
    profiles = {**profiles, _GUIDE: _with_last_map(profiles[_GUIDE], words[1])}
    return DayLevels(
        day=days,
        strokes=counts.astype(np.int64),
        figures={
            name: np.array([_level(values[one], forward[one]) for one in slices]) for name, values in columns.items()
        },
        x=x,
        profiles={
            name: np.array([_level(values[one], forward[one]) for one in slices]).reshape(len(slices), x.size)
            for name, values in profiles.items()
        },
        software=software,
        map=guide_map,
        parameters=parameters,
    )


def _with_last_map(profiles: Array, maps: Sequence[str]) -> Array:
    """Profiles (N, m) of the guide, NaN up to the last stroke whose map is not that of the last one with a profile."""
    seen = np.flatnonzero(np.isfinite(profiles).any(axis=1)).tolist()
    others = [place for place in seen if maps[place] != maps[seen[-1]]]
    if not others:
        return profiles
    kept = profiles.copy()
    kept[: others[-1] + 1] = np.nan
    return kept


def _level(values: Array, forward: NDArray[np.bool_]) -> Any:
    """Mean of the medians of both directions, of those that are there."""
    parts = [median_of(values[one]) for one in (forward, ~forward) if one.any()]
    if len(parts) == 1:
        return parts[0]
    first, second = parts
    middle = 0.5 * (first + second)
    return np.where(np.isnan(middle), np.where(np.isnan(first), second, first), middle)


def median_of(values: Array) -> Any:
    """Median over the first axis, without NaN; NaN where there is nothing else."""
    known = np.isfinite(values)
    if known.all():
        return np.median(values, axis=0)
    empty = ~known.any(axis=0)
    return np.where(empty, np.nan, np.nanmedian(np.where(empty, 0.0, values), axis=0))


def _floats(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _on_one_grid(
    begins: Sequence[int], lists: Mapping[str, Sequence[Sequence[float | None] | None]]
) -> tuple[Array, dict[str, Array]]:
    """Middles of all bins that any stroke has, (m,) in m, and each profile on them, (N, m)."""
    ends = [begin + BIN_MM * max(len(rows[k] or ()) for rows in lists.values()) for k, begin in enumerate(begins)]
    low, high = (min(begins), max(ends)) if begins else (0, 0)
    count = (high - low) // BIN_MM
    x: Array = (low + BIN_MM * (np.arange(count, dtype=np.float64) + 0.5)) * 1e-3
    profiles: dict[str, Array] = {}
    for name, rows in lists.items():
        values = np.full((len(begins), count), np.nan)
        for k, row in enumerate(rows):
            place = (begins[k] - low) // BIN_MM
            if row is not None:
                values[k, place : place + len(row)] = _floats(row)
        profiles[name] = values
    return x, profiles
