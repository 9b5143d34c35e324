"""The figures of one stroke."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import ReferenceMap, Stroke, StrokeRecord
from straightcomp_ros.straightness.residual import end_point_residual, least_squares_residual, peak_to_peak


@dataclass(frozen=True)
class StrokeFigures:
    """One movement one way; s, m.

    Attributes:
        direction: ``forward`` or ``backward``.
        start, duration: of the movement.
        travel: in x.
        encoder_pp, encoder_rms: compensation error as the encoder sees it.
        true_pp, true_rms: the true one, None without truth.
        before_least_squares, before_end_points: straightness of the guide by ISO 230-1, beside either line.
        after_least_squares, after_end_points: straightness of the workpiece, likewise. True positions where they are
            known, else the map's and the encoder's.
    """

    direction: str
    start: float
    duration: float
    travel: float
    encoder_pp: float
    encoder_rms: float
    true_pp: float | None
    true_rms: float | None
    before_least_squares: float
    before_end_points: float
    after_least_squares: float
    after_end_points: float

    def to_display(self) -> dict[str, Any]:
        """As a person reads them: lengths in µm, the travel in mm, the unit in each name."""
        shown: dict[str, Any] = {}
        for name, value in asdict(self).items():
            if name in ("start", "duration"):
                shown[f"{name}_s"] = value
            elif name == "travel":
                shown["travel_mm"] = value * 1e3
            elif name == "direction":
                shown[name] = value
            else:
                shown[f"{name}_um"] = None if value is None else value * 1e6
        return shown


def stroke_figures(
    record: StrokeRecord, reference: ReferenceMap, truth: NDArray[np.float64] | None, stroke: Stroke
) -> StrokeFigures:
    """Figures of ``stroke``.

    Args:
        record: the run.
        reference: its map.
        truth: (n,) true compensation error in m for all samples of the record, None where it is not known.
        stroke: which samples.
    """
    part = slice(stroke.start, stroke.stop)
    error = (record.r - record.y)[part]
    known = record.best_known(reference)
    x, guide, after = known.x[part], known.guide[part], (known.guide + known.y)[part]
    # In time the stage lingers where it starts and stops; each piece of the guide counts by its length.
    weights = np.abs(np.gradient(x, record.time[part]))
    of_truth = None if truth is None else truth[part]
    return StrokeFigures(
        direction=stroke.direction,
        start=float(record.time[stroke.start]),
        duration=float(record.time[stroke.stop - 1] - record.time[stroke.start]),
        travel=float(np.ptp(x)),
        encoder_pp=peak_to_peak(error),
        encoder_rms=_rms(error),
        true_pp=None if of_truth is None else peak_to_peak(of_truth),
        true_rms=None if of_truth is None else _rms(of_truth),
        before_least_squares=peak_to_peak(least_squares_residual(x, guide, weights)),
        before_end_points=peak_to_peak(end_point_residual(x, guide)),
        after_least_squares=peak_to_peak(least_squares_residual(x, after, weights)),
        after_end_points=peak_to_peak(end_point_residual(x, after)),
    )


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values * values)))
