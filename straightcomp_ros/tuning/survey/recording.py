"""A survey that was recorded over time, from a bag or CSV: its runs recognised, spikes rejected, and the map of them.

A recording has the stage's x and the sensor's reading. Two ways of measuring are recognised. *On the fly*: the stage
passes without a stop; the readings within each ``step`` of x make one point, at their mean x. *At rest*: the stage
stops at each point; the readings of the second half of each stop make one. The stop at which it turns back is the last
point of one run and the first of the next.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.map_building import FLOOR, GAUSSIAN, BuiltMap, Choices, build
from straightcomp_ros.analysis.record import SHORTEST_STROKE, MetricsError, Stroke, group_means, motion_of, whole_ways
from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.contract import DISPLACEMENT, ENCODER, PLATFORM, STAGE
from straightcomp_ros.straightness.guide_map import MapParameters
from straightcomp_ros.straightness.survey import Run, Survey, check_run
from straightcomp_ros.straightness.survey_header import DEVIATION, TIME_COLUMN, SurveyError
from straightcomp_ros.straightness.survey_table import RUN_COLUMN, number, numbered_lines, table_of

STAGE_X = Field(ENCODER.topic, f"position[{STAGE}]")
"""The slider's x in the topics of our own graph."""
_STOP = 0.2
"""Time in s from which a stand between two moves of a run is a stop for a measurement."""
_FEWEST_STOPS = 5
"""Stops from which a run is measured at rest."""
_HALF_WINDOW = 7
"""Readings to each side with which a reading is compared to find spikes."""


@dataclass(frozen=True)
class Sensor:
    """How the displacement sensor's readings, in ``unit``, become deviations.

    ``inverted``: the reading falls when the slider moves towards +y. ``delay``: time in s by which a reading is older
    than its stamp; an error in it shows as hysteresis. ``on_platform``: the sensor rides on the platform, so that the
    platform's own y is part of its reading.
    """

    readings: Field = Field(DISPLACEMENT.topic, f"position[{DISPLACEMENT.topic}]")
    unit: str = "m"
    inverted: bool = False
    delay: float = 0.0
    on_platform: bool = False


@dataclass(frozen=True, eq=False)
class Series:
    """Samples of a survey, (n,) each: rising time in s from the first sample, x and deviation in m.

    ``unusable`` is the number of readings left out: not finite, or while the stage's x was not recorded; ``inputs`` are
    the origins of the columns, in words by name.
    """

    source: str
    time: NDArray[np.float64]
    x: NDArray[np.float64]
    deviation: NDArray[np.float64]
    unusable: int
    inputs: Mapping[str, str]


def series_of_bag(bag: Path, stage: Field = STAGE_X, sensor: Sensor = Sensor()) -> Series:
    """Read a survey from a bag; x is interpolated to the times of the readings.

    Raises:
        BagError: the bag cannot be read, or lacks a topic or a field.
        SurveyError: stage and sensor were not recorded at the same time.
    """
    positions, readings = read_field(bag, stage), read_field(bag, sensor.readings)
    taken_at = readings.stamp - round(sensor.delay * 1e9)
    x, usable = positions.at(taken_at)
    deviation = readings.values / DEVIATION.columns[f"deviation_{sensor.unit}"] * (-1.0 if sensor.inverted else 1.0)
    if sensor.on_platform:
        y, known = read_field(bag, Field(stage.topic, f"position[{PLATFORM}]")).at(taken_at)
        deviation, usable = deviation - y, usable & known
    usable &= np.isfinite(deviation) & np.isfinite(x)
    if np.count_nonzero(usable) < 3:
        raise SurveyError(
            f"survey {bag}: {stage} and {sensor.readings} have {np.count_nonzero(usable)} common samples; were both "
            "recorded, and on one clock?"
        )
    time = (taken_at[usable] - taken_at[usable][0]) * 1e-9
    details = [
        f"{sensor.readings} in {sensor.unit}",
        "inverted" if sensor.inverted else "",
        f"{sensor.delay * 1e3:g} ms old" if sensor.delay else "",
        "on the platform" if sensor.on_platform else "",
        "" if readings.stamped else "by time of sending",
    ]
    origin = str(stage) + ("" if positions.stamped else ", by time of sending")
    inputs = {"stage": origin, "sensor": ", ".join(filter(None, details))}
    return Series(str(bag), time, x[usable], deviation[usable], int(np.count_nonzero(~usable)), inputs)


def series_of_csv(path: Path, names: Mapping[str, str] | None = None) -> Series | None:
    """Read a recording over time: columns ``time_s``, and x and deviation as in a survey file, where they may have
    these ``names``. None for a file that has points: without ``time_s``, or that names its runs or directions, or whose
    rows are a stop and a move apart.

    SurveyError if x or deviation is missing, a cell is no number, or time does not rise.
    """
    table = table_of(path, list(numbered_lines(path)), names)
    if TIME_COLUMN not in table.header or {"run", "direction", RUN_COLUMN}.intersection(table.header):
        return None
    samples: list[tuple[float, float, float]] = []
    for line, cells, x, deviation in table.rows:
        where = f"survey {path}, line {line}"
        time = number(where, TIME_COLUMN, cells[TIME_COLUMN])
        if samples and time <= samples[-1][0]:
            raise SurveyError(f"{where}: time_s {time:g} after {samples[-1][0]:g}; allowed: rising")
        samples.append((time, x, deviation))
    if len(samples) < 3:
        raise SurveyError(f"survey {path}: {len(samples)} rows; allowed: >= 3")
    columns = np.array(samples).T
    steps = np.diff(columns[:2])
    stands = np.abs(steps[1]) < SHORTEST_STROKE
    reversals = np.count_nonzero(np.diff(np.sign(steps[1, ~stands])))
    if np.median(steps[0]) >= _STOP and np.count_nonzero(stands) <= reversals:
        return None
    inputs = dict(zip(("stage", "sensor"), table.columns, strict=True))
    return Series(str(path), columns[0] - columns[0, 0], columns[1], columns[2], 0, inputs)


class Passage(NamedTuple):
    """One run as it was recognised: when it was driven in s, whether its points were measured at stops, and the numbers
    of its readings and of those that were rejected."""

    run: Run
    start_s: float
    duration_s: float
    at_rest: bool
    samples: int
    rejected_samples: int


def recognise(
    series: Series, step: float, limit: float, max_gap: float = MapParameters.max_gap
) -> tuple[tuple[Passage, ...], int]:
    """The whole runs of a survey, and the number of movements that were not whole (broken off, or to the start): that
    begin or end farther than ``max_gap`` in m from where most do. SurveyError if the stage does not move.

    On the fly, each ``step`` in m of x makes one point. Spikes are beyond ``limit`` robust standard deviations.
    """
    # A slow logger has too few samples within a move to find it: positions between them are tried as well.
    every = np.arange(float(len(series.time)))
    found, refused = (tuple[Passage, ...](), 0), None
    try:
        found = _recognised(series, every, step, limit, max_gap)
    except SurveyError as error:
        refused = error
    moving = np.flatnonzero(np.abs(np.diff(series.x)) >= SHORTEST_STROKE)
    if moving.size:
        denser = np.sort(np.concatenate([every, moving + 1.0 / 3.0, moving + 2.0 / 3.0]))
        with suppress(SurveyError):
            passages, partial = _recognised(series, denser, step, limit, max_gap)
            if _points_at_rest(passages) > _points_at_rest(found[0]):
                # A quick way back has few samples.
                runs = tuple(one for one in passages if one.at_rest or one.run.x.size >= MapParameters.min_points)
                return runs, partial + len(passages) - len(runs)
    if refused:
        raise refused
    return found


def _points_at_rest(passages: Sequence[Passage]) -> int:
    return sum(passage.run.x.size for passage in passages if passage.at_rest)


def _recognised(
    series: Series, at: NDArray[np.float64], step: float, limit: float, max_gap: float
) -> tuple[tuple[Passage, ...], int]:
    """The same by the moves of x between the samples ``at``, some of which may lie between those of the series."""
    every = np.arange(len(series.time))
    time, x = np.interp(at, every, series.time), np.interp(at, every, series.x)
    # The series' own sample at or after each.
    own = np.append(np.ceil(at).astype(np.intp), len(every))
    try:
        strokes = motion_of(time, x).strokes
    except MetricsError as error:
        raise SurveyError(f"survey {series.source}: {str(error).removeprefix('record: ')}") from error
    rests = dict(zip(strokes, [*(stroke.start for stroke in strokes[1:]), len(time)], strict=True))
    ways, partial = whole_ways(strokes, x)
    ends = np.sort([[x[way[0].start], x[way[-1].stop - 1]] for way in ways])
    near = np.abs(ends - np.median(ends, axis=0)).max(axis=1) <= max_gap
    chosen = [way for way, is_near in zip(ways, near.tolist(), strict=True) if is_near]
    # Where fewer than half agree none is known to be whole.
    chosen = chosen if 2 * len(chosen) >= len(ways) else ways
    passages: list[Passage] = []
    for way in chosen:
        if own[way[-1].stop] - own[way[0].start] < 2:
            continue
        name = str(1 + sum(passage.run.direction == way[0].direction for passage in passages))
        # Each move with the end of the rest after it.
        moves = [(Stroke(int(own[one.start]), int(own[one.stop]), one.direction), int(own[rests[one]])) for one in way]
        passages.append(_passage(series, moves, name, step, limit))
    return tuple(passages), len(partial) + len(ways) - len(passages)


def _passage(series: Series, moves: Sequence[tuple[Stroke, int]], name: str, step: float, limit: float) -> Passage:
    begin, end = moves[0][0].start, moves[-1][0].stop
    way = 1.0 if moves[0][0].direction == "forward" else -1.0
    stops = []
    for move, rest_end in moves:
        # In records that were joined, the stage may be back at the next sample. A slow logger's may still go on.
        onward = way * (series.x[move.stop : rest_end] - series.x[max(move.start - 1, 0)])
        back = np.flatnonzero(onward < SHORTEST_STROKE)
        rest = (move.stop, move.stop + int(back[0]) if back.size else rest_end)
        if _stands(series, *rest):
            stops.append(rest)
    at_rest = len(stops) >= _FEWEST_STOPS
    if at_rest:
        # The stand before the first move is a stop of this run too.
        away = np.flatnonzero(np.abs(series.x[:begin] - series.x[begin - 1]) >= SHORTEST_STROKE)
        arrived = int(away[-1]) + 1 if away.size else 0
        if _stands(series, arrived, begin):
            stops.append((arrived, begin))
        stops.sort(key=lambda stop: float(series.x[stop[1] - 1]))
        # The second half of each stop, when vibration from the motion has decayed.
        pieces = [np.arange((first + stop) // 2, stop) for first, stop in stops]
        chosen = np.concatenate(pieces)
        group = np.repeat(np.arange(len(stops)), [len(piece) for piece in pieces])
    else:
        chosen = np.arange(begin, end)
        group = np.round(series.x[chosen] / step).astype(np.int64)
    values = series.deviation[chosen]
    bad = spikes(values - (_middles(values, group) if at_rest else _from_neighbours(values)), limit)
    run = Run(name, moves[0][0].direction, *group_means(series.x[chosen][~bad], values[~bad], group[~bad]))
    start = float(series.time[begin])
    return Passage(run, start, float(series.time[end - 1]) - start, at_rest, len(chosen), int(bad.sum()))


def _stands(series: Series, first: int, stop: int) -> bool:
    """Whether the stand from sample ``first`` to ``stop`` is long enough for a measurement."""
    return bool(stop > first and series.time[stop - 1] - series.time[first] >= _STOP)


def spikes(residual: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
    """Which samples of a run are outliers; ``residual`` (n,) in m is the difference from the smoothed run."""
    distance = np.abs(residual - np.median(residual))
    return np.asarray(distance > max(limit * GAUSSIAN * float(np.median(distance)), FLOOR))


def _from_neighbours(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each reading estimated from its neighbours: the median of the means of opposite ones, which is exact on a slope.

    The reading itself is left out. In a running median it would be the result wherever the readings rise steadily.
    """
    half = min(_HALF_WINDOW, len(values) - 1)
    # Beyond the ends the readings are mirrored at the end point: a slope stays a slope.
    mirrored = np.pad(values, half, mode="reflect", reflect_type="odd")
    window = np.lib.stride_tricks.sliding_window_view(mirrored, 2 * half + 1)
    return np.asarray(np.median(0.5 * (window[:, :half] + window[:, : -half - 1 : -1]), axis=1))


def _middles(values: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
    """For each value the median of its group."""
    return np.array([np.median(values[group == one]) for one in range(group.max() + 1)])[group]


def build_from_series(
    series: Series, source: Path, choices: Choices, facts: Mapping[str, str]
) -> tuple[BuiltMap, tuple[Passage, ...]]:
    """Recognise the runs of a recording, and :func:`build` the map with these ``facts``; SurveyError also if there is
    no run."""
    guide = choices.guide
    passages, partial = recognise(series, choices.step, choices.limit, guide.max_gap)
    for passage in passages:
        run = passage.run
        where = f"survey {series.source}, run '{run.name}' {run.direction}"
        if run.x.size < guide.min_points:
            more = "more stops give" if passage.at_rest else f"a smaller step than {choices.step * 1e3:g} mm gives"
            raise SurveyError(f"{where}: {run.x.size} points; allowed: >= {guide.min_points} (min_points): {more} more")
        check_run(where, run, guide.max_gap)
    built = build(Survey(tuple(p.run for p in passages), series.source, facts), source, choices, series.inputs)
    counts = {
        "partial_runs": partial,
        "samples": sum(passage.samples for passage in passages),
        "rejected_samples": sum(passage.rejected_samples for passage in passages),
        "unusable_samples": series.unusable,
    }
    return replace(built, counts=counts), passages
