"""From a measured survey to the map: outliers out, repeatability reported, provenance written into the file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.survey_runs import Passage, recognise
from straightcomp_ros.analysis.survey_series import Series
from straightcomp_ros.bags.origin import origin
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap
from straightcomp_ros.straightness.mean import mean_of_directions, on_common_grid
from straightcomp_ros.straightness.outliers import disagreement
from straightcomp_ros.straightness.repeatability import Repeatability, repeatability
from straightcomp_ros.straightness.residual import end_point_residual, least_squares_residual, peak_to_peak
from straightcomp_ros.straightness.survey import Survey, write_survey
from straightcomp_ros.straightness.survey_columns import DEVIATION, SurveyError, X
from straightcomp_ros.straightness.survey_run import Run, check_gaps


@dataclass(frozen=True)
class Choices:
    """What the builder is told.

    Attributes:
        step: length in m of the piece of x that makes one point of a run on the fly.
        limit: outliers are further out than so many robust standard deviations.
        level: take the least squares line of the mean out of all runs: straight edge and guide were not parallel.
        parameters: what the finished map must fulfil.
    """

    step: float
    limit: float
    level: bool = False
    parameters: MapParameters = MapParameters()


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """A survey that became a map.

    Attributes:
        survey: the runs that are kept, without their rejected points.
        straightness: the map made of them.
        repeatability: of these runs.
        mean: (n,) of the mean deviation in m over ``repeatability.x``.
        rejected_points: (run's name and direction, x in m) of points that no other run confirms.
        rejected_runs: names and directions.
        passages: the runs as they were recognised; empty for a survey that lists its points.
        partial: movements that were no whole run.
        unusable: readings that were left out before.
        provenance: by name, in words; the head of the file.
    """

    survey: Survey
    straightness: StraightnessMap
    repeatability: Repeatability
    mean: NDArray[np.float64]
    rejected_points: tuple[tuple[str, float], ...]
    rejected_runs: tuple[str, ...]
    passages: tuple[Passage, ...]
    partial: int
    unusable: int
    provenance: Mapping[str, str]

    def figures(self) -> dict[str, Any]:
        """By name, the unit in each name."""
        x = self.repeatability.x
        return {
            "points": len(x),
            "first_mm": float(x[0]) * 1e3,
            "last_mm": float(x[-1]) * 1e3,
            "forward_runs": len(self.survey.in_direction("forward")),
            "backward_runs": len(self.survey.in_direction("backward")),
            "rejected_runs": len(self.rejected_runs),
            "partial_runs": self.partial,
            "rejected_points": len(self.rejected_points),
            "samples": sum(p.samples for p in self.passages),
            "rejected_samples": sum(p.spikes for p in self.passages),
            "unusable_samples": self.unusable,
            "straightness_least_squares_um": peak_to_peak(least_squares_residual(x, self.mean)) * 1e6,
            "straightness_end_points_um": peak_to_peak(end_point_residual(x, self.mean)) * 1e6,
            "correction_pp_um": peak_to_peak(self.mean) * 1e6,
            **self.repeatability.to_display(),
        }

    def write(self, path: Path) -> None:
        """Write the map: a survey file, its provenance in comments at the head.

        Raises:
            OSError: the file cannot be written.
        """
        write_survey(path, self.survey, [f"{name}: {text}" for name, text in self.provenance.items()])


def build_from_series(series: Series, source: Path, choices: Choices) -> BuiltMap:
    """Recognise the runs of a recording and build.

    Raises:
        SurveyError: there is no run, or what is left makes no map.
    """
    found = recognise(series, choices.step, choices.limit)
    for passage in found.passages:
        run = passage.run
        where = f"survey {series.source}, run '{run.name}' {run.direction}"
        if run.x.size < choices.parameters.min_points:
            raise SurveyError(
                f"{where}: {run.x.size} points; allowed: >= {choices.parameters.min_points} (min_points): "
                f"a smaller step than {choices.step * 1e3:g} mm gives more"
            )
        X.check_extent(where, float(run.x[-1] - run.x[0]))
        DEVIATION.check_extent(where, float(np.ptp(run.deviation)))
        check_gaps(where, run, choices.parameters.max_gap)
    survey = Survey(tuple(p.run for p in found.passages), series.source)
    built = build(survey, source, choices, series.inputs)
    return replace(built, passages=found.passages, partial=found.partial, unusable=series.unusable)


def build(survey: Survey, source: Path, choices: Choices, inputs: Mapping[str, str] | None = None) -> BuiltMap:
    """Reject what does not agree, and build.

    Args:
        survey: the runs; where their zero lies is arbitrary, the mean over all is taken out.
        source: bag or file that they come from.
        choices: see :class:`Choices`.
        inputs: words for the provenance.

    Raises:
        SurveyError: the runs do not fit together, too few are left, or the correction exceeds the platform's travel.
    """
    parameters = choices.parameters
    x, values = _gridded(survey, parameters)
    kept, lost_runs, lost_points = _agreeing(survey, x, values, choices)
    if not kept:
        raise SurveyError(f"survey {survey.source}: no run is left after the rejection of outliers")
    survey = Survey(kept, survey.source)
    x, values = _gridded(survey, parameters)
    survey = _zeroed(survey, x, mean_of_directions(survey, values), choices.level)
    x, values = _gridded(survey, parameters)
    found = repeatability(survey, x, values)
    return BuiltMap(
        survey=survey,
        straightness=StraightnessMap(survey, parameters),
        repeatability=found,
        mean=mean_of_directions(survey, values),
        rejected_points=tuple(lost_points),
        rejected_runs=tuple(lost_runs),
        passages=(),
        partial=0,
        unusable=0,
        provenance=_provenance(source, choices, inputs or {}, survey, found, lost_runs, lost_points),
    )


def _gridded(survey: Survey, parameters: MapParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return on_common_grid(survey, min_points=parameters.min_points, max_gap=parameters.max_gap)


def _agreeing(
    survey: Survey, x: NDArray[np.float64], values: NDArray[np.float64], choices: Choices
) -> tuple[tuple[Run, ...], list[str], list[tuple[str, float]]]:
    """The runs without outliers, in their order; names of rejected runs; rejected points."""
    outlier = np.zeros(values.shape, np.bool_)
    rejected = np.zeros(len(values), np.bool_)
    for direction in ("forward", "backward"):
        ours = np.array([run.direction == direction for run in survey.runs])
        if ours.any():
            found = disagreement(values[ours], choices.limit)
            rejected[ours], outlier[ours] = found.runs, found.points
    kept: list[Run] = []
    lost: list[str] = []
    points: list[tuple[str, float]] = []
    for run, gone, bad in zip(survey.runs, rejected, outlier, strict=True):
        # The run's own point nearest to each bad point of the grid.
        places = np.unique([int(np.abs(run.x - at).argmin()) for at in x[bad]]).astype(np.intp)
        left = np.delete(run.x, places)
        if gone or left.size < 2 or np.diff(left).max() > choices.parameters.max_gap + 1e-9:
            lost.append(_label(run))
            continue
        points += [(_label(run), float(run.x[place])) for place in places]
        kept.append(replace(run, x=left, deviation=np.delete(run.deviation, places)))
    return tuple(kept), lost, points


def _zeroed(survey: Survey, x: NDArray[np.float64], mean: NDArray[np.float64], level: bool) -> Survey:
    slope, height = np.polyfit(x, mean, 1) if level else (0.0, float(mean.mean()))
    return Survey(
        tuple(replace(run, deviation=run.deviation - (height + slope * run.x)) for run in survey.runs), survey.source
    )


def _label(run: Run) -> str:
    return f"{run.name} {run.direction}"


def _provenance(
    source: Path,
    choices: Choices,
    inputs: Mapping[str, str],
    survey: Survey,
    found: Repeatability,
    lost_runs: Sequence[str],
    lost_points: Sequence[tuple[str, float]],
) -> dict[str, str]:
    by = origin()
    r = found.bidirectional
    return {
        "made by": f"straightcomp map build, {by['package']} {by['version']} ({by['revision']}), "
        f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC",
        "source": f"{Path(source).absolute().name}, sha256 {_digest(Path(source))}",
        **inputs,
        "choices": f"step {choices.step * 1e3:g} mm, outliers beyond {choices.limit:g} robust standard deviations, "
        f"{'least squares line' if choices.level else 'mean'} taken out",
        "runs": f"{len(survey.in_direction('forward'))} forward, {len(survey.in_direction('backward'))} backward; "
        f"rejected runs: {', '.join(lost_runs) or 'none'}; rejected points: {len(lost_points)}",
        "repeatability (ISO 230-2, bidirectional)": "unknown" if r is None else f"{r * 1e6:.3f} um",
    }


def _digest(source: Path) -> str:
    """Of the file, or of all files of a bag that hold messages, in the order of their names."""
    files = [source] if source.is_file() else sorted([*source.glob("*.mcap"), *source.glob("*.db3")])
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()[:16]
