"""A map from the runs of a survey: outliers rejected, repeatability reported, provenance written.

Spikes within a run, and points or runs that differ from the others, are found by Hampel's identifier: a value is an
outlier if it is further from the median than ``limit`` robust standard deviations, 1.4826 times the median absolute
deviation (F. R. Hampel, J. Am. Stat. Assoc. 69, 1974). Neither the median nor that deviation moves with the outliers
themselves, as mean and standard deviation do.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from straightcomp_ros.analysis.straightness_statement import POINTS, Statement, map_input, stated
from straightcomp_ros.bags.information import origin
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.residual import peak_to_peak
from straightcomp_ros.straightness.smoothing import NORMAL_95
from straightcomp_ros.straightness.survey import GRACE, Run, Survey, write_survey
from straightcomp_ros.straightness.survey_header import WAYS, SurveyError
from straightcomp_ros.straightness.survey_runs import on_common_grid, repeatability

GAUSSIAN = 1.4826
FLOOR = 20e-9
"""Distance in m from the median below which nothing is an outlier: runs that agree to a nanometre by chance must not
condemn one that differs by five."""
_WHOLE_RUN = 0.25
"""Fraction of outliers above which a run is rejected as a whole: something was knocked, or came loose."""
_WIDEST = 3
"""Most neighbouring outliers in a run; with more it is rejected too, since interpolation would be a guess."""
OUTLIERS = 6.0
"""Robust standard deviations beyond which a reading, a point or a run is an outlier, unless another limit is chosen."""
_FEWEST = 3
"""Fewest runs of one direction that can be compared: of two that differ, neither is known to be wrong."""


MAP = MapParameters(travel=math.inf)
"""Of a map that is made for no described stage: whose platform follows it, and how far, is not known."""


class Choices(NamedTuple):
    """Settings of the builder: ``step``, the length in m of the piece of x that makes one point of a run on the fly;
    ``limit``, the number of robust standard deviations beyond which a value is an outlier; and whether the map is made
    ``level``: the least squares line of the mean is taken out, since straight edge and guide were not parallel.
    ``guide`` says what is demanded of the survey, and how the map is made of it."""

    step: float
    limit: float
    level: bool = False
    guide: MapParameters = MAP


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """A survey that became a map.

    ``measured`` has all runs, with the mean taken out; the map's own survey has those that are kept, without the
    ``rejected_points`` (run's name and direction, x in m) that no other run confirms; ``rejected_runs`` are names and
    directions; ``provenance``, by name and in words, is the head of the file. Of a recording, ``counts`` says by the
    names in :meth:`figures` how many samples and movements were used and left out.
    """

    straightness: StraightnessMap
    rejected_points: list[tuple[str, float]]
    rejected_runs: list[str]
    provenance: Mapping[str, str]
    measured: Survey
    counts: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def statements(self) -> list[Statement]:
        """The straightness of the map, the mean of both directions, about each line, with its uncertainty."""
        x = np.linspace(*self.straightness.span, POINTS)
        curve = (x, x, self.straightness.deviations(x))
        return stated(
            "before", "forward", [curve], [map_input(self.straightness, seen=True)], repeats=False, as_points=True
        )

    def figures(self) -> dict[str, Any]:
        """By name, the unit in each name."""
        kept, report, noise = self.straightness.survey, self.straightness.report, self.straightness.noise
        x, mean = report.x, report.mean
        return {
            "points": len(x),
            "first_mm": float(x[0]) * 1e3,
            "last_mm": float(x[-1]) * 1e3,
            "forward_runs": len(kept.in_direction("forward")),
            "backward_runs": len(kept.in_direction("backward")),
            "rejected_runs": len(self.rejected_runs),
            "partial_runs": self.counts.get("partial_runs", 0),
            "rejected_points": len(self.rejected_points),
            **{name: self.counts.get(name, 0) for name in ("samples", "rejected_samples", "unusable_samples")},
            **{f"straightness_{one.line}_um": one.value * 1e6 for one in self.statements},
            "correction_pp_um": peak_to_peak(mean) * 1e6,
            **report.to_display(),
            "hysteresis_of_map_um": self.straightness.hysteresis * 1e6,
            "smoothed": noise.smoothed,
            "noise_of_mean_um": noise.point * 1e6,
            "map_uncertainty_95_um": noise.half_width * 1e6,
            "map_uncertainty_95_twice_the_runs_um": NORMAL_95 * noise.twice * 1e6,
        }

    def write(self, path: Path) -> None:
        """Write the map as a survey file with its provenance in comments at the head."""
        write_survey(path, self.straightness.survey, [f"{name}: {text}" for name, text in self.provenance.items()])


def build(survey: Survey, source: Path, choices: Choices, inputs: Mapping[str, str] | None = None) -> BuiltMap:
    """Reject runs and points that do not agree with the others, and build the map.

    The zero of a deviation is arbitrary: the mean over all runs is subtracted. ``source`` is the bag or file that they
    come from, ``inputs`` are words for the provenance. SurveyError if the runs do not fit together, too few are left,
    or the correction exceeds the platform's travel.
    """
    guide = choices.guide
    kept, lost_runs, lost_points = agreeing(survey, choices.limit, guide)
    if not kept:
        raise SurveyError(f"survey {survey.source}: no run is left after the rejection of outliers")
    of_kept = replace(survey, runs=tuple(kept))
    x, values = on_common_grid(of_kept, guide.min_points, guide.max_gap)
    mean = repeatability(of_kept, x, values).mean
    slope, height = np.polyfit(x, mean, 1) if choices.level else (0.0, float(mean.mean()))

    def zeroed(runs: Iterable[Run]) -> Survey:
        ours = (replace(run, deviation=run.deviation - (height + slope * run.x)) for run in runs)
        return replace(survey, runs=tuple(ours))

    measured, survey = zeroed(survey.runs), zeroed(kept)
    straightness = StraightnessMap(survey, guide)
    by, spread = origin(), straightness.report.bidirectional
    provenance = {
        **survey.facts,
        "made by": f"straightcomp map build, {by['package']} {by['version']} ({by['revision']}), "
        f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        "source": f"{source.absolute().name}, sha256 {_digest(source)}",
        **(inputs or {}),
        "choices": f"step {choices.step * 1e3:g} mm, outliers beyond {choices.limit:g} robust standard deviations, "
        f"{'least squares line' if choices.level else 'mean'} taken out, stage.guide.smooth {guide.smooth}",
        "runs": f"{len(survey.in_direction('forward'))} forward, {len(survey.in_direction('backward'))} backward; "
        f"rejected runs: {', '.join(lost_runs) or 'none'}; rejected points: {len(lost_points)}",
        "noise": f"{'taken off' if straightness.noise.smoothed else 'left in'}; {straightness.noise}",
        "tables": "one for each direction" if straightness.directed else "the mean of both directions",
        "repeatability (ISO 230-2, bidirectional)": "unknown" if spread is None else f"{spread * 1e6:.3f} um",
    }
    return BuiltMap(straightness, lost_points, lost_runs, provenance, measured)


def as_it_is(guide: MapParameters) -> BuiltMap:
    """The map of ``guide`` with its survey, of which nothing is rejected; SurveyError as :func:`load_map` raises it."""
    straightness = load_map(guide)
    return BuiltMap(straightness, [], [], straightness.survey.facts, straightness.survey)


def agreeing(
    survey: Survey, limit: float, guide: MapParameters
) -> tuple[list[Run], list[str], list[tuple[str, float]]]:
    """The runs without outliers, in their order; names of rejected runs, also of those that have then fewer points,
    wider gaps or ends farther from the others' than ``guide`` allows; rejected points. SurveyError if the runs do not
    fit together as it demands."""
    x, values = on_common_grid(survey, guide.min_points, guide.max_gap)
    outlier = np.zeros(values.shape, np.bool_)
    rejected = np.zeros(len(values), np.bool_)
    for direction in WAYS:
        ours = np.array([run.direction == direction for run in survey.runs])
        if ours.any():
            rejected[ours], outlier[ours] = disagreement(values[ours], limit)
    sound = [run for run, gone in zip(survey.runs, rejected, strict=True) if not gone]
    start, end = min(run.x[0] for run in sound), max(run.x[-1] for run in sound)
    kept, lost, points = list[Run](), list[str](), list[tuple[str, float]]()
    for run, gone, bad in zip(survey.runs, rejected, outlier, strict=True):
        label = f"{run.name} {run.direction}"
        # The run's own point nearest to each bad point of the grid.
        nearest = np.unique([int(np.abs(run.x - at).argmin()) for at in x[bad]]).astype(np.intp)
        left = np.delete(run.x, nearest)
        # For an end that is too far from another run's all would be refused.
        widest = np.diff([start, *left, end]).max()
        if gone or left.size < guide.min_points or widest > guide.max_gap + GRACE:
            lost.append(label)
            continue
        points += [(label, float(run.x[index])) for index in nearest]
        kept.append(replace(run, x=left, deviation=np.delete(run.deviation, nearest)))
    return kept, lost, points


def _digest(source: Path) -> str:
    """Of the file, or of all files of a bag that hold messages, in the order of their names."""
    files = [source] if source.is_file() else sorted([*source.glob("*.mcap"), *source.glob("*.db3")])
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()[:16]


def disagreement(values: NDArray[np.float64], limit: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which runs of one direction are rejected as a whole, (runs,), and which single points of the others, (runs, n).

    ``values`` (runs, n) in m are on one grid of at least four points; ``limit`` is in robust standard deviations, which
    are taken over all points.
    """
    rejected = np.zeros(len(values), np.bool_)
    points = np.zeros(values.shape, np.bool_)
    while np.count_nonzero(~rejected) >= _FEWEST:
        kept = values[~rejected]
        distance = np.abs(kept - np.median(kept, axis=0))
        # With an odd number of runs one is the median itself; its zeros would make the others' spread seem small.
        others = distance[distance > 0.0]
        spread = float(np.median(others)) if others.size else 0.0
        flagged = distance > max(limit * GAUSSIAN * spread, FLOOR)
        stretches = sliding_window_view(flagged, _WIDEST + 1, axis=1)
        unusable = (flagged.mean(axis=1) > _WHOLE_RUN) | np.any(np.all(stretches, axis=2), axis=1)
        if not unusable.any():
            points[~rejected] = flagged
            break
        # One by one: the worst run moves the median for the others.
        worst = np.where(unusable, distance.sum(axis=1), -1.0).argmax()
        rejected[np.flatnonzero(~rejected)[worst]] = True
    return rejected, points
