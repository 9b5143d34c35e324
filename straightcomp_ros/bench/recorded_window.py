"""Evaluates a bag in a time window: samples missing on each topic, and the loop's latency."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import read_streams
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, STREAMS


@dataclass(frozen=True)
class Recording:
    """The streams of a bag in a window.

    Attributes:
        expected: samples that the sampling clock took in the window.
        missing: by topic, the number of these samples without a message.
        amplifier_on: fraction of the recorded samples with the amplifier on, which the law acts on.
        latency: (n,) time in s from each sample to the arrival of its command at the driver, as far as recorded.
    """

    expected: int
    missing: Mapping[str, int]
    amplifier_on: float
    latency: NDArray[np.float64]

    @property
    def lost_samples(self) -> int:
        """Samples without a command, wherever they were lost: before the law, after it, or by the logger."""
        return self.missing[COMMAND.topic]

    def latency_us(self) -> dict[str, float]:
        """``p50``, ``p99``, ``p999`` and ``max`` in µs; NaN without any."""
        percents = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}
        if not len(self.latency):
            return dict.fromkeys(percents, float("nan"))
        values = np.percentile(self.latency, list(percents.values())) * 1e6
        return dict(zip(percents, values.tolist(), strict=True))


def read_window(bag: Path, rate: int, begin_ns: int, end_ns: int) -> Recording:
    """Count what a bag has of the samples in [begin_ns, end_ns).

    Args:
        bag: rosbag2 folder of the graph's logger.
        rate: samples per second.
        begin_ns, end_ns: stamps, ns since the epoch.

    Raises:
        BagError: the bag cannot be read or has no samples in the window.
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
    missing = {
        stream.topic: expected
        - (len(np.unique(streams[stream.topic].stamp[inside(stream.topic)])) if stream.topic in streams else 0)
        for stream in STREAMS
    }
    latency = enabled = np.empty(0)
    if DRIVER_STATE.topic in streams:
        columns, wanted = streams[DRIVER_STATE.topic].columns, inside(DRIVER_STATE.topic)
        latency, enabled = columns["command_latency"][wanted], columns["enabled"][wanted]
    amplifier_on = float(enabled.mean()) if len(enabled) else float("nan")
    return Recording(expected, missing, amplifier_on, latency[np.isfinite(latency)])
