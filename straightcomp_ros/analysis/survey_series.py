"""A measured survey: the stage's x and the displacement sensor's reading over time, from a bag or CSV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags.fields import Field, FieldValues, read_field
from straightcomp_ros.contract import DISPLACEMENT, ENCODER, PLATFORM, STAGE
from straightcomp_ros.straightness.survey_columns import DEVIATION, read_table
from straightcomp_ros.straightness.text import SurveyError, number

TIME_COLUMN = "time_s"
"""A CSV file with this column is a recording over time; without it, a list of the points of runs."""
STAGE_X = Field(ENCODER.topic, f"position[{STAGE}]")
"""The slider's x in the topics of our own graph."""
_LONGEST_GAP_NS = 100_000_000
"""Time between two samples of the stage; across a longer one its x is not interpolated."""


@dataclass(frozen=True)
class Sensor:
    """How the displacement sensor's readings become deviations.

    Attributes:
        readings: topic and field; a relative topic as :func:`straightcomp_ros.bags.topics.resolved` takes it.
        unit: of the readings, ``m``, ``mm``, ``um`` or ``nm``.
        inverted: the reading falls when the slider moves towards +y.
        delay: time in s by which a reading is older than its stamp; an error in it shows as hysteresis.
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
        source: the survey's name in messages.
        time: (n,) s, rising, from the first sample.
        x, deviation: (n,) m.
        unusable: number of readings left out: not finite, or while the stage's x was not recorded.
        inputs: origin of the columns, in words by name.
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
    positions, readings = _read(bag, stage), _read(bag, sensor.readings)
    taken_at = readings.stamp - round(sensor.delay * 1e9)
    x, usable = _at(positions, taken_at)
    deviation = readings.values / DEVIATION.per_metre[sensor.unit] * (-1.0 if sensor.inverted else 1.0)
    if sensor.on_platform:
        y, known = _at(_read(bag, Field(stage.topic, f"position[{PLATFORM}]")), taken_at)
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
        SurveyError: the file cannot be read, or lacks x or deviation.
    """
    return TIME_COLUMN in read_table(path).header


def series_of_csv(path: Path) -> Series:
    """Read a recording over time: columns ``time_s``, and x and deviation as in a survey file.

    Raises:
        SurveyError: a column is missing, a cell is no number, or time does not rise.
    """
    table = read_table(path)
    time_column = table.header.index(TIME_COLUMN)
    samples: list[tuple[float, float, float]] = []
    for line, row in table.rows:
        where = f"survey {path}, line {line}"
        time = number(where, TIME_COLUMN, row[time_column].strip())
        if samples and time <= samples[-1][0]:
            raise SurveyError(f"{where}: time_s {time:g} after {samples[-1][0]:g}; allowed: rising")
        samples.append((time, table.x.metres(where, row), table.deviation.metres(where, row)))
    if len(samples) < 3:
        raise SurveyError(f"survey {path}: {len(samples)} rows; allowed: >= 3")
    time, x, deviation = np.array(samples).T
    inputs = {"stage": table.header[table.x.index], "sensor": table.header[table.deviation.index]}
    return Series(str(path), time - time[0], x, deviation, 0, inputs)


def _read(bag: Path, field: Field) -> FieldValues:
    """The values of a field by stamp, without repetitions."""
    values = read_field(bag, field)
    stamp, first = np.unique(values.stamp, return_index=True)
    return FieldValues(stamp, values.values[first], values.stamped)


def _at(known: FieldValues, stamps: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Values at ``stamps``, and where they are known: at a sample, or between two that are not far apart."""
    first, last = known.stamp[0], known.stamp[-1]
    place = np.searchsorted(known.stamp[:-1], stamps)
    near = np.diff(known.stamp, prepend=first)[place] <= _LONGEST_GAP_NS
    usable = (known.stamp[place] == stamps) | (near & (stamps > first) & (stamps < last))
    return np.interp((stamps - first) * 1e-9, (known.stamp - first) * 1e-9, known.values), usable
