"""The runs in a survey that was recorded over time: the direction and the points of each run.

Two ways of measuring are recognised. *On the fly*: the stage passes without a stop; the readings within each ``step``
of x make one point, at their mean x. *At rest*: the stage stops at each point; the readings of the second half of each
stop make one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import MetricsError, Stroke, motion_of
from straightcomp_ros.analysis.survey_series import Series
from straightcomp_ros.straightness.outliers import spikes
from straightcomp_ros.straightness.survey import Run, SurveyError

_WHOLE = 0.9
"""Fraction of the longest run's travel from which a run is whole: others were broken off, or lead to the start."""
_STOP = 0.2
"""Time in s from which a stand between two moves of a run is a stop for a measurement."""
_FEWEST_STOPS = 5
"""Stops from which a run is measured at rest."""
_HALF_WINDOW = 7
"""Readings to each side with which a reading is compared to find spikes."""


class Passage(NamedTuple):
    """One run as it was recognised.

    Attributes:
        run: its points.
        start, duration: of the motion, s from the first sample.
        at_rest: whether its points were measured at stops.
        samples, spikes: numbers of its readings, and of those that were rejected.
    """

    run: Run
    start: float
    duration: float
    at_rest: bool
    samples: int
    spikes: int


class Recognised(NamedTuple):
    """The whole runs of a survey, and the number of movements that were not whole (broken off, or to the start)."""

    passages: tuple[Passage, ...]
    partial: int


def recognise(series: Series, step: float, limit: float) -> Recognised:
    """Find the runs of a survey.

    Args:
        series: the survey.
        step: length in m of the piece of x that makes one point, on the fly.
        limit: number of robust standard deviations beyond which a reading is a spike.

    Raises:
        SurveyError: the stage does not move.
    """
    try:
        strokes = motion_of(series.time, series.x).strokes
    except MetricsError as error:
        raise SurveyError(f"survey {series.source}: {str(error).removeprefix('record: ')}") from error
    # Successive moves in one direction belong to one run.
    groups = [list(moves) for _, moves in groupby(strokes, key=lambda stroke: stroke.direction)]
    travels = [abs(float(series.x[group[-1].stop - 1] - series.x[group[0].start])) for group in groups]
    whole = [group for group, travel in zip(groups, travels, strict=True) if travel >= _WHOLE * max(travels)]
    counts = {"forward": 0, "backward": 0}
    passages = []
    for group in whole:
        direction = group[0].direction
        counts[direction] += 1
        rest_end = next((s.start for s in strokes if s.start >= group[-1].stop), len(series.time))
        passages.append(_passage(series, group, rest_end, str(counts[direction]), step, limit))
    return Recognised(tuple(passages), len(groups) - len(whole))


def _passage(series: Series, moves: Sequence[Stroke], rest_end: int, name: str, step: float, limit: float) -> Passage:
    begin, end = moves[0].start, moves[-1].stop
    stops = [
        (first, stop)
        for first, stop in zip(
            [move.stop for move in moves], [*(move.start for move in moves[1:]), rest_end], strict=True
        )
        if stop > first and series.time[stop - 1] - series.time[first] >= _STOP
    ]
    at_rest = len(stops) >= _FEWEST_STOPS
    if at_rest:
        # The second half of each stop, when vibration from the motion has decayed.
        pieces = [np.arange((first + stop) // 2, stop) for first, stop in stops]
        chosen = np.concatenate(pieces)
        group = np.repeat(np.arange(len(stops)), [len(piece) for piece in pieces])
    else:
        chosen = np.arange(begin, end)
        group = np.round(series.x[chosen] / step).astype(np.int64)
    values = series.deviation[chosen]
    bad = spikes(values - (_middles(values, group) if at_rest else _course(values)), limit)
    x, deviation = _means(series.x[chosen][~bad], values[~bad], group[~bad])
    run = Run(name, moves[0].direction, x, deviation)
    start = float(series.time[begin])
    return Passage(run, start, float(series.time[end - 1]) - start, at_rest, len(chosen), int(bad.sum()))


def _course(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each reading estimated from its neighbours: the median of the means of opposite ones, which is exact on a slope.

    The reading itself is left out. In a running median it would be the result wherever the readings rise steadily.
    """
    half = min(_HALF_WINDOW, len(values) - 1)
    # Beyond the ends the readings are mirrored at the end point: a slope stays a slope.
    before, after = 2.0 * values[0] - values[half:0:-1], 2.0 * values[-1] - values[-2 : -half - 2 : -1]
    window = np.lib.stride_tricks.sliding_window_view(np.concatenate([before, values, after]), 2 * half + 1)
    return np.asarray(np.median(0.5 * (window[:, :half] + window[:, : -half - 1 : -1]), axis=1))


def _middles(values: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
    """For each value the median of its group."""
    names, place = np.unique(group, return_inverse=True)
    return np.array([np.median(values[group == name]) for name in names])[place]


def _means(
    x: NDArray[np.float64], deviation: NDArray[np.float64], group: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean x and deviation of each group, x ascending."""
    _, place = np.unique(group, return_inverse=True)
    count = np.bincount(place)
    means = np.bincount(place, x) / count, np.bincount(place, deviation) / count
    order = np.argsort(means[0])
    return means[0][order], means[1][order]
