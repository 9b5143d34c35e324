"""A proposed map: the old one, changed by what a displacement sensor saw of the guide on the last days' strokes.

The encoder of y sees the platform relative to the slider. Whether the guide under the slider has moved, neither it nor
what is learned from stroke to stroke (r − y) shows: a sensor on the slider that measures against a straight edge must
be recorded with the strokes. What it sees of single strokes is noisier than a survey, but there are many of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.map_building import BuiltMap, Choices, build
from straightcomp_ros.fleet.history.rows import BIN_MM, checksum_of
from straightcomp_ros.stage.due_maintenance import MaintenanceError
from straightcomp_ros.straightness.guide_map import StraightnessMap
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.survey import Direction, Run, Survey, read_survey

if TYPE_CHECKING:
    import pyarrow

COLUMNS = ["start", "direction", "bins_from_mm", "guide_change_um", "map_checksum", "verdict"]
"""Columns of the store that :func:`proposed_map` reads."""
_RUNS = 5
"""Each way: ISO 230-2 asks for five."""
_LIMIT = 6.0
"""Robust standard deviations beyond which a run or point is rejected, as in `straightcomp map build`."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A map to look at, next to the old one.

    Attributes:
        built: the map with its provenance.
        old: the map that the strokes were driven with.
        strokes: how many it is made from.
        change: (n,) new minus old deviation in m, over ``built.repeatability.x``, without its mean.
    """

    built: BuiltMap
    old: StraightnessMap
    strokes: int
    change: NDArray[np.float64]

    def figures(self) -> dict[str, Any]:
        """By name, the unit in each name."""
        return {
            "strokes": self.strokes,
            "change_pp_um": peak_to_peak(self.change) * 1e6,
            "largest_change_at_mm": float(self.built.repeatability.x[np.abs(self.change).argmax()]) * 1e3,
            **self.built.figures(),
        }


def proposed_map(strokes: pyarrow.Table, old: Path, days: float) -> Proposal:
    """The map from the strokes of the last ``days`` days before the last stroke.

    Args:
        strokes: of one stage in the order of their start, with at least :data:`COLUMNS`.
        old: the survey that these strokes used.
        days: few enough that the guide moves little in them, many enough to average readings.

    Raises:
        MaintenanceError: too few strokes have a displacement sensor, or ran with another map.
        SurveyError: a map is refused.
    """
    survey = read_survey(old)
    before = StraightnessMap(survey)
    checksum = checksum_of([old.read_bytes()])
    rows = strokes.select(COLUMNS).to_pylist()
    if rows:
        last = rows[-1]["start"]
        rows = [row for row in rows if (last - row["start"]).total_seconds() <= days * 86_400.0]
    seen = [row for row in rows if row["guide_change_um"] is not None and row["verdict"] == "in_order"]
    if not seen:
        raise MaintenanceError(
            f"none of the {len(rows)} strokes of the last {days:g} days that were in order has a displacement sensor: "
            "record 'displacement' with the strokes, or survey the guide; encoders alone do not see it move"
        )
    ours = [row for row in seen if row["map_checksum"] == checksum]
    x = before.report.x
    runs: list[Run] = []
    ways: tuple[Direction, ...] = ("forward", "backward")
    for way in ways:
        changes = [_at(row, x) for row in ours if row["direction"] == way]
        if len(changes) < _RUNS:
            other = len(seen) - len(ours)
            raise MaintenanceError(
                f"{len(changes)} strokes {way} with a displacement sensor and the map {old} in the last {days:g} days, "
                f"{other} with another map; allowed: >= {_RUNS} each way; give more days, or the map of these strokes"
            )
        deviation = before.deviations(x)
        for number, group in enumerate(np.array_split(np.array(changes), _RUNS), 1):
            runs.append(Run(str(number), way, x, deviation + np.median(group, axis=0)))
    first, end = ours[0]["start"], ours[-1]["start"]
    inputs = {
        "proposed from": f"{len(ours)} strokes from {first:%Y-%m-%d %H:%M} to {end:%Y-%m-%d %H:%M} UTC, in {_RUNS} "
        "groups each way, by their displacement sensor",
        "changes": f"map {old.name}, BLAKE2b {checksum}",
    }
    choices = Choices(step=1e-3 * BIN_MM, limit=_LIMIT)
    built = build(Survey(tuple(runs), str(old)), old, choices, inputs)
    made = built.provenance["made by"].replace("map build", "history map")
    built = replace(built, provenance={**built.provenance, "made by": made})
    at = built.repeatability.x
    change = built.mean - before.deviations(at)
    return Proposal(built, before, len(ours), change - change.mean())


def _at(row: dict[str, Any], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of the guide in m at ``x`` (m,) in m; beyond the stroke that of its nearest bin."""
    values = np.array([np.nan if one is None else one for one in row["guide_change_um"]], np.float64)
    middles = (row["bins_from_mm"] + BIN_MM * (np.arange(values.size) + 0.5)) * 1e-3
    known = np.isfinite(values)
    return np.asarray(np.interp(x, middles[known], values[known])) * 1e-6
