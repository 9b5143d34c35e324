"""A proposed map: the old one, changed by what a displacement sensor saw of the guide on the last days' strokes.

The encoder of y sees the platform relative to the slider. Whether the guide under the slider has moved, neither it nor
what is learned from stroke to stroke (r − y) shows: a sensor on the slider that measures against a straight edge must
be recorded with the strokes. What it sees of single strokes is noisier than a survey, but there are many of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.judgement import IN_ORDER, WRONG_GUIDE
from straightcomp_ros.analysis.map_building import MAP, OUTLIERS, BuiltMap, Choices, build
from straightcomp_ros.analysis.record import Array, whole
from straightcomp_ros.fleet.history.rows import BIN_MM, checksum_of
from straightcomp_ros.fleet.maintenance.day_levels import GUIDE_BINS, on_one_grid
from straightcomp_ros.stage.due_maintenance import MaintenanceError
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import Run, Survey, read_survey
from straightcomp_ros.straightness.survey_header import WAYS
from straightcomp_ros.straightness.survey_table import MARK

if TYPE_CHECKING:
    import pyarrow

_COLUMNS = ["start", "direction", GUIDE_BINS, "map_checksum", "verdict"]
_RUNS = 5
"""Each way: ISO 230-2 asks for five."""
_OFTEN = 3
"""Readings each way from which a place belongs to the whole strokes: one or two were of strokes that went farther."""
_OF_MACHINE = ("machine", MARK)
"""What the old map says that is true of the new one too: not when, by whom and with what it was measured."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A map to look at, next to the old one."""

    built: BuiltMap  # the map with its provenance
    strokes: int  # how many it is made from
    change: NDArray[np.float64]  # (n,) new minus old deviation in m, over the x of the report, without its mean

    def figures(self) -> dict[str, Any]:
        """By name, the unit in each name."""
        return {
            "strokes": self.strokes,
            "change_pp_um": peak_to_peak(self.change) * 1e6,
            "largest_change_at_mm": float(self.built.straightness.report.x[np.abs(self.change).argmax()]) * 1e3,
            **self.built.figures(),
        }


def proposed_map(strokes: pyarrow.Table, old: Path, days: float, guide: MapParameters = MAP) -> Proposal:
    """The map from the ``strokes`` of a stage, in the order of their start, within ``days`` before the last one.

    Few enough days that the guide moves little in them, many enough to average readings. ``old`` is the survey that
    these strokes used, and ``guide`` says what is demanded of it, and how maps are made.

    Raises:
        MaintenanceError: too few strokes have a displacement sensor, or ran with another map.
        SurveyError: a map is refused.
    """
    before = StraightnessMap(read_survey(old, min_points=guide.min_points, max_gap=guide.max_gap), guide)
    checksum = checksum_of([old.read_bytes()])
    rows = strokes.select(_COLUMNS).to_pylist()
    recent = [n for n, row in enumerate(rows) if rows[-1]["start"] - row["start"] <= timedelta(days=days)]
    # That the guide is no longer the map's is what a new map is for.
    sound = [n for n in recent if rows[n]["verdict"] in (IN_ORDER, WRONG_GUIDE)]
    seen = [n for n in sound if rows[n][GUIDE_BINS] is not None]
    if not seen:
        raise MaintenanceError(
            f"none of the {len(recent)} strokes of the last {days:g} days in which the servo worked has a displacement "
            "sensor: record 'displacement' with the strokes, or survey the guide; encoders alone do not see it move"
        )
    ours = np.array([rows[n]["map_checksum"] == checksum for n in seen])
    forward = np.array([rows[n]["direction"] == "forward" for n in seen])
    middles, profiles = on_one_grid(strokes.take(seen))
    known = np.isfinite(profiles[GUIDE_BINS])
    read = known[ours].any(axis=0)
    place = np.minimum(*(np.count_nonzero(known[ours & way], axis=0) for way in (forward, ~forward))) >= _OFTEN
    if 2 * np.count_nonzero(place) < np.count_nonzero(read):
        # Those that went farther are the whole ones, and the others jogs.
        place = read
    # By place, not by length: parts of a stroke may be equally long, and the mean of each is zero over its own x.
    covered = np.count_nonzero(known[:, place], axis=1)
    chosen = ours & (covered > 0) & whole(covered, int(np.count_nonzero(place)))
    x, at, changes = before.report.x, middles[place], profiles[GUIDE_BINS][:, place]
    runs: list[Run] = []
    for way, these in zip(WAYS, (forward, ~forward), strict=True):
        of_way = [_at(one, at, x) for one in changes[chosen & these]]
        if len(of_way) < _RUNS:
            shorter = np.count_nonzero(ours & ~chosen)
            parts = "; a stroke that stops on the way is recorded in parts, which are shorter ones" if shorter else ""
            raise MaintenanceError(
                f"{len(of_way)} whole strokes {way} with a displacement sensor and the map {old} in the last {days:g} "
                f"days, {shorter} shorter ones, {np.count_nonzero(~ours)} with another map; allowed: >= {_RUNS} each "
                f"way; give more days, or the map of these strokes{parts}"
            )
        groups = np.array_split(np.array(of_way), _RUNS)
        runs += [
            Run(str(n), way, x, before.deviations(x, way) + np.median(group, axis=0))
            for n, group in enumerate(groups, 1)
        ]
    starts = [rows[n]["start"] for n in np.array(seen)[chosen]]
    inputs = {
        "proposed from": f"{len(starts)} strokes from {starts[0]:%Y-%m-%d %H:%M} to {starts[-1]:%Y-%m-%d %H:%M} UTC, "
        f"in {_RUNS} groups each way, by their displacement sensor",
        "changes": f"map {old.name}, BLAKE2b {checksum}",
    }
    choices = Choices(step=1e-3 * BIN_MM, limit=OUTLIERS, guide=guide)
    facts = {name: text for name, text in before.survey.facts.items() if name in _OF_MACHINE}
    built = build(Survey(tuple(runs), str(old), facts), old, choices, inputs)
    made = built.provenance["made by"].replace("map build", "history map")
    built = replace(built, provenance={**built.provenance, "made by": made})
    at = built.straightness.report.x
    change = built.straightness.report.mean - before.deviations(at)
    return Proposal(built, len(starts), change - change.mean())


def _at(change: Array, middles: Array, x: Array) -> Array:
    """A stroke's ``change`` of the guide (n,) in µm at ``middles`` (n,) in m, at ``x`` (m,) in m: in m and without its
    mean; beyond the stroke that of its nearest bin."""
    known = np.isfinite(change)
    return np.asarray(np.interp(x, middles[known], change[known] - change[known].mean())) * 1e-6
