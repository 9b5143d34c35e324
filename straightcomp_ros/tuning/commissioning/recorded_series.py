"""Samples of a running graph, as its logger recorded them."""

from pathlib import Path

import numpy as np

from straightcomp_ros.analysis.current_path import advanced, readback_lag
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams, values_at
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER
from straightcomp_ros.tuning.commissioning import CommissioningError
from straightcomp_ros.tuning.commissioning.machine import COASTING, Series


def recorded_series(bag: Path) -> Series:
    """All samples of ``bag``; those without a command have NaN for it.

    Raises:
        CommissioningError: the bag cannot be read.
    """
    wanted = (ENCODER, COMMAND, DRIVER_STATE)
    try:
        streams = read_streams(bag, {stream.topic: stream.layout for stream in wanted})
    except BagError as error:
        raise CommissioningError(str(error)) from error
    if ENCODER.topic not in streams:
        none = np.empty(0)
        return Series(np.empty(0, np.int64), none, none, none, none, none)
    encoder = streams[ENCODER.topic]
    stamps, rows = np.unique(encoder.stamp, return_index=True)

    x, y, current = (encoder.columns[name][rows] for name in ("x", "y", "coil_current"))
    current = advanced(current, readback_lag(bag))
    command = values_at(streams.get(COMMAND.topic), "control_current", stamps)
    latency = values_at(streams.get(DRIVER_STATE.topic), "command_latency", stamps)
    return Series(stamps, x, y, current, command, latency)


def excited(series: Series, travel: float, rate: float) -> Series:
    """The part of an open-loop series from its first current on, until the platform has come to rest.

    Args:
        series: of a graph under the law `open_loop`, whose commands are those of the excitation.
        travel: beyond which the amplifier went off, m.
        rate: of the samples, Hz.

    Raises:
        CommissioningError: the amplifier is never on.
    """
    on = np.isfinite(series.current)
    acting = np.flatnonzero(np.nan_to_num(series.command) != 0.0)
    if not on.any():
        raise CommissioningError("the amplifier is off throughout the bag")
    # A ramp begins with a zero of its own. Without any current the magnets pulled the platform away by themselves.
    first = max(0, int(acting[0]) - 1) if acting.size else int(np.argmax(on))
    off = np.flatnonzero(np.isnan(series.current[first:]))
    end = first + int(off[0]) if off.size else len(series.stamps)
    beyond = np.flatnonzero(~(np.abs(series.y[first:] - series.y[first]) <= travel))
    left_at = int(beyond[0]) if beyond.size else None
    if left_at is not None:
        # The part in which the platform comes to rest.
        end = max(end, first + left_at + 1) + round(COASTING * rate)
    part = slice(first, end)
    return Series(
        series.stamps[part],
        series.x[part],
        series.y[part],
        series.current[part],
        np.nan_to_num(series.command[part]),
        series.latency[part],
        left_at,
    )
