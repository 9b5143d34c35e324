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
from straightcomp_ros.analysis.map_building import BuiltMap, Choices, build
from straightcomp_ros.analysis.record import whole
from straightcomp_ros.fleet.history.rows import BIN_MM, checksum_of
from straightcomp_ros.stage.due_maintenance import MaintenanceError
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import Run, Survey, read_survey
from straightcomp_ros.straightness.survey_table import Direction

if TYPE_CHECKING:
    import pyarrow

_COLUMNS = ["start", "direction", "bins_from_mm", "guide_change_um", "map_checksum", "verdict"]
_RUNS = 5
"""Each way: ISO 230-2 asks for five."""
_LIMIT = 6.0
"""Robust standard deviations beyond which a run or point is rejected, as in `straightcomp map build`."""


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


def proposed_map(strokes: pyarrow.Table, old: Path, days: float) -> Proposal:
    """The map from the ``strokes`` of a stage, in the order of their start, within ``days`` before the last one.

    Few enough days that the guide moves little in them, many enough to average readings. ``old`` is the survey that
    these strokes used.

    Raises:
        MaintenanceError: too few strokes have a displacement sensor, or ran with another map.
        SurveyError: a map is refused.
    """
    before = StraightnessMap(read_survey(old))
    checksum = checksum_of([old.read_bytes()])
    rows = strokes.select(_COLUMNS).to_pylist()
    recent = [row for row in rows if rows[-1]["start"] - row["start"] <= timedelta(days=days)]
    # That the guide is no longer the map's is what a new map is for.
    sound = [row for row in recent if row["verdict"] in (IN_ORDER, WRONG_GUIDE)]
    seen = [row for row in sound if row["guide_change_um"] is not None]
    if not seen:
        raise MaintenanceError(
            f"none of the {len(recent)} strokes of the last {days:g} days in which the servo worked has a displacement "
            "sensor: record 'displacement' with the strokes, or survey the guide; encoders alone do not see it move"
        )
    ours = [row for row in seen if row["map_checksum"] == checksum]
    travels = [len(row["guide_change_um"]) for row in ours]
    jogs = len(ours) - np.count_nonzero(whole(travels))
    ours = [row for row, is_whole in zip(ours, whole(travels).tolist(), strict=True) if is_whole]
    x = before.report.x
    runs: list[Run] = []
    ways: tuple[Direction, ...] = ("forward", "backward")
    for way in ways:
        changes = [_at(row, x) for row in ours if row["direction"] == way]
        if len(changes) < _RUNS:
            other = len(seen) - len(ours) - jogs
            raise MaintenanceError(
                f"{len(changes)} whole strokes {way} with a displacement sensor and the map {old} in the last {days:g} "
                f"days, {jogs} shorter ones, {other} with another map; allowed: >= {_RUNS} each way; give more days, "
                "or the map of these strokes"
            )
        groups = np.array_split(np.array(changes), _RUNS)
        runs += [
            Run(str(n), way, x, before.deviations(x, way) + np.median(group, axis=0))
            for n, group in enumerate(groups, 1)
        ]
    first, end = ours[0]["start"], ours[-1]["start"]
    inputs = {
        "proposed from": f"{len(ours)} strokes from {first:%Y-%m-%d %H:%M} to {end:%Y-%m-%d %H:%M} UTC, in {_RUNS} "
        "groups each way, by their displacement sensor",
        "changes": f"map {old.name}, BLAKE2b {checksum}",
    }
    built = build(Survey(tuple(runs), str(old)), old, Choices(step=1e-3 * BIN_MM, limit=_LIMIT), inputs)
    made = built.provenance["made by"].replace("map build", "history map")
    built = replace(built, provenance={**built.provenance, "made by": made})
    at = built.straightness.report.x
    change = built.straightness.report.mean - before.deviations(at)
    return Proposal(built, len(ours), change - change.mean())


def _at(row: dict[str, Any], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of the guide in m at ``x`` (m,) in m; beyond the stroke that of its nearest bin."""
    values = np.array(row["guide_change_um"], np.float64)
    middles = (row["bins_from_mm"] + BIN_MM * (np.arange(values.size) + 0.5)) * 1e-3
    known = np.isfinite(values)
    return np.asarray(np.interp(x, middles[known], values[known])) * 1e-6
