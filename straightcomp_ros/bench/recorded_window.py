"""Evaluates a bag in a time window: samples missing on each topic, and the loop's latency."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, STREAMS

_PERCENTS = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def read_window(bag: Path, rate: int, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """What a bag of the graph's logger has of the samples at ``rate`` Hz with stamps in [begin_ns, end_ns).

    ``lost_samples`` have no command, wherever they were lost: before the law, after it, or by the logger.
    ``latency_us`` has percentiles of the time from each sample to its command's arrival at the driver; NaN without any.
    Of ``bag``, ``expected_samples`` are those that the sampling clock took, ``missing`` the number of these without a
    message by topic, and ``amplifier_on`` the fraction of the recorded ones with the amplifier on. BagError if the bag
    cannot be read or has no samples in the window.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in STREAMS})
    period_ns = round(1e9 / rate)

    def inside(topic: str) -> NDArray[np.bool_]:
        stamp = streams[topic].stamp
        return np.asarray((stamp >= begin_ns) & (stamp < end_ns))

    if ENCODER.topic not in streams or not inside(ENCODER.topic).any():
        raise BagError(f"bag {bag}: has no messages on '{ENCODER.topic}' in the window that was measured")
    phase = int(streams[ENCODER.topic].stamp[inside(ENCODER.topic)][0])
    # Samples lie on a grid, so losses at an edge of the window count too.
    expected = -((phase - end_ns) // period_ns) + (phase - begin_ns) // period_ns
    found = {topic: len(np.unique(stream.stamp[inside(topic)])) for topic, stream in streams.items()}
    missing = {stream.topic: expected - found.get(stream.topic, 0) for stream in STREAMS}
    latency = enabled = np.empty(0)
    if DRIVER_STATE.topic in streams:
        columns, wanted = streams[DRIVER_STATE.topic].columns, inside(DRIVER_STATE.topic)
        latency, enabled = columns["command_latency"][wanted], columns["enabled"][wanted]
        latency = latency[np.isfinite(latency)]
    percentiles = np.percentile(latency, list(_PERCENTS.values())) if len(latency) else np.full(len(_PERCENTS), np.nan)
    return {
        "lost_samples": missing[COMMAND.topic],
        "latency_us": dict(zip(_PERCENTS, (percentiles * 1e6).tolist(), strict=True)),
        "bag": {
            "complete": not any(missing.values()),
            "expected_samples": expected,
            "missing": missing,
            "amplifier_on": float(enabled.mean()) if len(enabled) else float("nan"),
        },
    }
