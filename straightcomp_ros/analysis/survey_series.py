"""A survey as it was measured: the stage's x and the displacement sensor's reading over time, from a bag or CSV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags.fields import Field, FieldValues, read_field
from straightcomp_ros.contract import DISPLACEMENT, ENCODER, PLATFORM, STAGE
from straightcomp_ros.straightness.csv_rows import metres, number, rows
from straightcomp_ros.straightness.survey_columns import DEVIATION, SurveyError, X, find_column, normalised

TIME_COLUMN = "time_s"
"""A CSV file with this column is a recording over time; one without lists the points of runs."""
STAGE_X = Field(ENCODER.topic, f"position[{STAGE}]")
"""Where our own graph says x."""
_LONGEST_GAP_NS = 100_000_000
"""Time between two samples of the stage; across a longer one its x is not interpolated."""


@dataclass(frozen=True)
class Sensor:
    """How the displacement sensor's readings become deviations.

    Attributes:
        readings: topic and field; a relative topic as :func:`straightcomp_ros.bags.topics.resolved` takes it.
        unit: of the readings, ``m``, ``mm``, ``um`` or ``nm``.
        inverted: true where a slider that moves towards +y makes the reading smaller.
        delay: time in s by which a reading is older than its stamp. What is neglected here shows as hysteresis.
        on_platform: the sensor rides on the platform, so that the platform's own y is part of its reading.
    """

    readings: Field = Field(DISPLACEMENT.topic, f"position[{DISPLACEMENT.topic}]")
    unit: str = "m"
    inverted: bool = False
    delay: float = 0.0
    on_platform: bool = False


@dataclass(frozen=True, eq=False)
class Series:
    """Samples of a survey.

    Attributes:
        source: names it in messages.
        time: (n,) s, rising, from the first sample.
        x, deviation: (n,) m.
        unusable: readings that were left out: not finite, or while the stage's x was not recorded.
        inputs: where the columns came from, in words by name.
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
    positions, readings = _rising(read_field(bag, stage)), _rising(read_field(bag, sensor.readings))
    taken_at = readings.stamp - round(sensor.delay * 1e9)
    x, usable = _at(positions, taken_at)
    deviation = readings.values / DEVIATION.per_metre[sensor.unit] * (-1.0 if sensor.inverted else 1.0)
    if sensor.on_platform:
        platform = _rising(read_field(bag, Field(stage.topic, f"position[{PLATFORM}]")))
        y, known = _at(platform, taken_at)
        deviation, usable = deviation - y, usable & known
    usable &= np.isfinite(deviation) & np.isfinite(x)
    if np.count_nonzero(usable) < 3:
        raise SurveyError(
            f"survey {bag}: {stage} and {sensor.readings} have {np.count_nonzero(usable)} common samples; were both "
            "recorded, and on one clock?"
        )
    time = (taken_at[usable] - taken_at[usable][0]) * 1e-9
    inputs = {
        "stage": str(stage) + ("" if positions.stamped else ", by time of sending"),
        "sensor": f"{sensor.readings} in {sensor.unit}"
        + (", inverted" if sensor.inverted else "")
        + (f", {sensor.delay * 1e3:g} ms old" if sensor.delay else "")
        + (", on the platform" if sensor.on_platform else "")
        + ("" if readings.stamped else ", by time of sending"),
    }
    return Series(str(bag), time, x[usable], deviation[usable], int(np.count_nonzero(~usable)), inputs)


def is_series(path: Path) -> bool:
    """Whether a CSV file is a recording over time.

    Raises:
        SurveyError: the file cannot be read.
    """
    _, header = next(rows(path), (0, []))
    return TIME_COLUMN in map(normalised, header)


def series_of_csv(path: Path) -> Series:
    """Read a recording over time: columns ``time_s``, and x and deviation as in a survey file.

    Raises:
        SurveyError: a column is missing, a cell is no number, or time does not rise.
    """
    lines = rows(path)
    header_line, cells = next(lines)
    header = [normalised(cell) for cell in cells]
    where = f"survey {path}, line {header_line}"
    x_column, deviation_column = find_column(where, header, X), find_column(where, header, DEVIATION)
    time_column = header.index(TIME_COLUMN)
    table: list[tuple[float, float, float]] = []
    for line, row in lines:
        if len(row) != len(header):
            raise SurveyError(f"survey {path}, line {line}: {len(row)} cells, the header has {len(header)}")
        time = number(path, line, row[time_column], TIME_COLUMN)
        if table and time <= table[-1][0]:
            raise SurveyError(f"survey {path}, line {line}: time_s {time:g} after {table[-1][0]:g}; allowed: rising")
        table.append((time, metres(path, line, row, x_column), metres(path, line, row, deviation_column)))
    if len(table) < 3:
        raise SurveyError(f"survey {path}: {len(table)} rows; allowed: >= 3")
    time, x, deviation = np.array(table).T
    inputs = {"stage": header[x_column.index], "sensor": header[deviation_column.index]}
    return Series(str(path), time - time[0], x, deviation, 0, inputs)


def _rising(values: FieldValues) -> FieldValues:
    """By stamp, without repetitions."""
    stamp, first = np.unique(values.stamp, return_index=True)
    return FieldValues(stamp, values.values[first], values.stamped)


def _at(known: FieldValues, stamps: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Values at other times, and where they are known: at a sample, or between two that are not far apart."""
    first, last = known.stamp[0], known.stamp[-1]
    place = np.searchsorted(known.stamp[:-1], stamps)
    near = np.diff(known.stamp, prepend=first)[place] <= _LONGEST_GAP_NS
    usable = (known.stamp[place] == stamps) | (near & (stamps > first) & (stamps < last))
    return np.interp((stamps - first) * 1e-9, (known.stamp - first) * 1e-9, known.values), usable
