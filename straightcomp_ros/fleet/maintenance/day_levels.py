"""The figures of a stage that are watched for wear, and their levels from day to day.

A level is a median, which single strokes that went wrong do not move.

The two directions of motion differ, so that each has its median, and their mean is the level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.judgement import INTERRUPTED
from straightcomp_ros.analysis.record import Array, whole
from straightcomp_ros.fleet.history.rows import BIN_MM

if TYPE_CHECKING:
    import pyarrow


class Watched(NamedTuple):
    """A figure that is watched for wear."""

    name: str  # column of the store; GUIDE is made from guide_change_um
    words: str  # for people
    unit: str  # of its values
    # Least scatter from day to day that is assumed: a figure that hardly scatters during its baseline must not make an
    # alarm of every tremor.
    relative: float = 0.002  # as a fraction of the level
    absolute: float = 0.0  # in the unit
    falling: bool = False  # whether a fall is watched too; of the others only a rise is bad


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
FIGURES = tuple(one.name for one in WATCHED if one.name != GUIDE)
"""Columns of the store that are watched."""
GUIDE_BINS, ERROR_BINS = "guide_change_um", "error_bins_um"
"""Columns of the store over x that are watched or shown."""
SETTINGS = {"software": "software_version", "map": "map_checksum", "parameters": "parameters_checksum"}
"""Columns of the store that say what people changed."""
BASELINE = 28
"""Days with strokes that make the baseline."""
_SMOOTH = 5
"""Bins over which a profile is averaged: guides move over centimetres, readings scatter from bin to bin."""
_DEGREE = 2
_WHOLE_DAYS = 0.9
"""Quantile of the days' longest strokes that is the whole way: a stroke over all of it may be made once a week."""


@dataclass(frozen=True, eq=False)
class DayLevels:
    """One entry for each day with strokes, in order."""

    day: NDArray[np.int64]  # (n,) days since 1970-01-01
    columns: Mapping[str, Array]  # by name of FIGURES, (n,) median of the day; NaN where no stroke has it
    x: Array  # (m,) m, middles of the bins
    # By name of the columns over x, (n, m) median of the day in µm; NaN where not known. That of the guide is known of
    # the whole strokes with the last map alone: another map, or a shorter travel, is another zero.
    profiles: Mapping[str, Array]
    # By name of SETTINGS, (n,) of the last stroke of the day, empty where unknown.
    settings: Mapping[str, Sequence[str]]

    def date(self, place: int) -> date:
        """Date of entry ``place``."""
        found: date = self.day[place].astype("datetime64[D]").item()
        return found

    @cached_property
    def shifts(self) -> Array:
        """Change (n, m) in µm of the guide's profiles since their baseline, smooth and without its parabola; NaN
        without a profile."""
        profiles = self.profiles[GUIDE_BINS]
        found = np.full(profiles.shape, np.nan)
        measured = np.isfinite(profiles).any(axis=1)
        # Where most days are known: single strokes went farther.
        inside = np.count_nonzero(np.isfinite(profiles), axis=0) > 0.5 * np.count_nonzero(measured)
        days = np.flatnonzero(np.isfinite(profiles[:, inside]).all(axis=1))
        if not days.size or np.count_nonzero(inside) <= _DEGREE:
            return found
        known = profiles[np.ix_(days, inside)]
        change = known - known[:BASELINE].mean(axis=0)
        at = self.x[inside]
        powers = np.vander(at - at.mean(), _DEGREE + 1)
        local = change - (powers @ np.linalg.lstsq(powers, change.T, rcond=None)[0]).T
        kernel = np.ones(min(_SMOOTH, at.size))
        # At the ends over the bins that are there.
        weight = np.convolve(np.ones(at.size), kernel, mode="same")
        found[np.ix_(days, inside)] = [np.convolve(one, kernel, mode="same") / weight for one in local]
        return found

    @property
    def measured(self) -> NDArray[np.intp]:
        """Places of the days on which the change of the guide is known."""
        return np.flatnonzero(np.isfinite(self.shifts).any(axis=1))

    @cached_property
    def figures(self) -> dict[str, Array]:
        """The levels of all watched figures, (n,) each, that of the guide among them."""
        size, known = np.full(len(self.day), np.nan), self.shifts[self.measured]
        size[self.measured] = np.nanmax(known, axis=1, initial=-np.inf) - np.nanmin(known, axis=1, initial=np.inf)
        return {GUIDE: size, **self.columns}


def day_levels(strokes: pyarrow.Table) -> DayLevels:
    """The levels from the strokes of a stage in the order of their start, at least one."""
    day = strokes["start"].to_numpy().astype("datetime64[D]").astype(np.int64)
    # The figures of a part of a motion are no others' measure: of few strokes a day it would be the median.
    part = strokes["verdict"].to_numpy() == INTERRUPTED
    columns = {name: np.where(part, np.nan, strokes[name].to_numpy().astype(np.float64)) for name in FIGURES}
    x, profiles = on_one_grid(strokes)
    profiles = {name: np.where(part[:, np.newaxis], np.nan, values) for name, values in profiles.items()}
    settings = {name: [value or "" for value in strokes[column].to_pylist()] for name, column in SETTINGS.items()}
    forward = strokes["direction"].to_numpy() == "forward"
    days, first, counts = np.unique(day, return_index=True, return_counts=True)

    def levels(values: Array) -> Array:
        """Of each day the mean of the medians of both directions, of those that are there."""
        found = np.empty((days.size, *values.shape[1:]))
        for k, (start, count) in enumerate(zip(first.tolist(), counts.tolist(), strict=True)):
            one, ways = values[start : start + count], forward[start : start + count]
            found[k] = median_of(np.array([median_of(one[way]) for way in (ways, ~ways) if way.any()]))
        return found

    last = (first + counts - 1).tolist()
    profiles[GUIDE_BINS] = _comparable(profiles[GUIDE_BINS], settings["map"], first)
    return DayLevels(
        day=days,
        columns={name: levels(values) for name, values in columns.items()},
        x=x,
        profiles={name: levels(values) for name, values in profiles.items()},
        settings={name: [values[place] for place in last] for name, values in settings.items()},
    )


def _comparable(profiles: Array, maps: Sequence[str], first: NDArray[np.intp]) -> Array:
    """Profiles (N, m) of the guide with one zero, the others NaN: up to the last stroke whose map is not that of the
    last one with a profile, and of jogs, whose mean is that of their own x. ``first`` are the days' first strokes.

    A stroke is whole by the way that is gone on one day in ten: one that went farther once makes no jogs of the others.
    """
    seen = np.flatnonzero(np.isfinite(profiles).any(axis=1)).tolist()
    others = [place for place in seen if maps[place] != maps[seen[-1]]]
    kept = profiles.copy()
    kept[: others[-1] + 1 if others else 0] = np.nan
    known = np.isfinite(kept)
    # From the first bin with a reading to the last.
    travels = np.where(known.any(axis=1), known.shape[1] - known.argmax(1) - known[:, ::-1].argmax(1), 0)
    longest = np.maximum.reduceat(travels, first)
    if longest.any():
        kept[~whole(travels, float(np.quantile(longest[longest > 0], _WHOLE_DAYS, method="lower")))] = np.nan
    return kept


def median_of(values: Array) -> Any:
    """Median over the first axis, without NaN; NaN where there is nothing else."""
    known = np.isfinite(values)
    if known.all():
        return np.median(values, axis=0)
    empty = ~known.any(axis=0)
    return np.where(empty, np.nan, np.nanmedian(np.where(empty, 0.0, values), axis=0))


def on_one_grid(strokes: pyarrow.Table) -> tuple[Array, dict[str, Array]]:
    """Middles of all bins that any stroke has, (m,) in m, and each profile on them, (N, m); at least one stroke."""
    import pyarrow.compute as compute

    begins = strokes["bins_from_mm"].to_numpy() // BIN_MM
    cells = {}
    for name in (GUIDE_BINS, ERROR_BINS):
        lists = strokes[name].combine_chunks()
        stroke = compute.list_parent_indices(lists).to_numpy()
        bins = begins[stroke] + np.arange(stroke.size) - np.searchsorted(stroke, stroke)
        cells[name] = stroke, bins, compute.list_flatten(lists).to_numpy(zero_copy_only=False)
    low = begins.min()
    count = max(begins.max(), *(bins.max(initial=low - 1) + 1 for _, bins, _ in cells.values())) - low
    x: Array = (BIN_MM * low + BIN_MM * (np.arange(count, dtype=np.float64) + 0.5)) * 1e-3
    profiles = {name: np.full((begins.size, count), np.nan) for name in cells}
    for name, (stroke, bins, values) in cells.items():
        profiles[name][stroke, bins - low] = values
    return x, profiles
