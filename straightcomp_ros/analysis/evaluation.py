"""What a bag says of a run: the record of the stroke, the counts of its samples, the loop's latency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams
from straightcomp_ros.bags.recorded_parameters import recorded_parameters
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, REFERENCE, TRUTH

_EVALUATED = (ENCODER, REFERENCE, COMMAND, DRIVER_STATE, TRUTH)


@dataclass(frozen=True)
class BagEvaluation:
    """A recorded run.

    Attributes:
        record: the samples of the run that have sample, reference and command (and truth, in a simulation). The
            run begins when the amplifier is switched on: before that the nodes are still finding each other. A bag
            in which it is never on is a run as a whole.
        expected_samples: samples that the sampling clock took from the run's first to its last in the bag.
        received_samples: different samples of the run in the bag.
        lost_references: samples of the run without a reference, up to the last that has one.
        lost_commands: samples of the run without a command, likewise.
        latency: time in s from each sample to the arrival of its command at the driver, as far as recorded.
        lateness: time in s from each sample until the driver published it, as far as recorded.
        stamps: (n,) ns, the run's different samples in the bag, in order; those of ``record`` are among them.
        amplifier_on: (n,) for the same samples.
        parameters: of the recorded nodes, by node and dotted name; empty when none are attached.
    """

    record: StrokeRecord
    expected_samples: int
    received_samples: int
    lost_references: int
    lost_commands: int
    latency: NDArray[np.float64]
    lateness: NDArray[np.float64]
    stamps: NDArray[np.int64]
    amplifier_on: NDArray[np.bool_]
    parameters: Mapping[str, Mapping[str, Any]]

    @property
    def lost_samples(self) -> int:
        """Samples that the clock took and the bag does not have."""
        return self.expected_samples - self.received_samples

    def latency_us(self, percentile: float) -> float:
        """Percentile of the latency in µs; NaN if none was recorded."""
        return float(np.percentile(self.latency, percentile)) * 1e6 if len(self.latency) else math.nan


def evaluate_bag(bag: Path, remap: Mapping[str, str] | None = None) -> BagEvaluation:
    """Read a bag of the graph and put the streams together by their stamps.

    Args:
        bag: rosbag2 folder or MCAP file.
        remap: the bag's topic for each of ours that is named otherwise there.

    Raises:
        BagError: the bag cannot be read, or lacks encoder, reference or command.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in _EVALUATED}, remap)
    parameters = recorded_parameters(bag, read_attachments(bag))
    for stream in (ENCODER, REFERENCE, COMMAND):
        if stream.topic not in streams or len(streams[stream.topic].stamp) < 2:
            raise BagError(f"bag {bag}: has no messages on '{stream.topic}'; was the whole graph running?")
    encoder, encoder_rows = _unique(streams[ENCODER.topic])
    on = encoder[np.isfinite(streams[ENCODER.topic].columns["coil_current"][encoder_rows])]
    if len(on):
        first = np.searchsorted(encoder, on[0])
        encoder, encoder_rows = encoder[first:], encoder_rows[first:]
    reference, reference_rows = _unique(streams[REFERENCE.topic])
    command, command_rows = _unique(streams[COMMAND.topic])
    common = np.intersect1d(np.intersect1d(encoder, reference, True), command, True)
    if TRUTH.topic in streams:
        truth, truth_rows = _unique(streams[TRUTH.topic])
        common = np.intersect1d(common, truth, True)
    if len(common) < 2:
        raise BagError(f"bag {bag}: its streams do not belong together: they have no common stamps")

    def column(name: str, topic: str, stamps: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
        return streams[topic].columns[name][rows[np.searchsorted(stamps, common)]]

    true_x = true_y = guide = None
    if TRUTH.topic in streams:
        true_x, true_y, guide = (
            column(name, TRUTH.topic, truth, truth_rows) for name in ("true_x", "true_y", "guide_deviation")
        )
    record = StrokeRecord(
        time=(common - common[0]) * 1e-9,
        x=column("x", ENCODER.topic, encoder, encoder_rows),
        y=column("y", ENCODER.topic, encoder, encoder_rows),
        r=column("r", REFERENCE.topic, reference, reference_rows),
        current=column("control_current", COMMAND.topic, command, command_rows),
        true_x=true_x,
        true_y=true_y,
        guide=guide,
        law=str(parameters.get("controller", {}).get("control.law", "unknown")),
    )
    driver = streams[DRIVER_STATE.topic].columns if DRIVER_STATE.topic in streams else {}
    latency, lateness = (driver.get(name, np.empty(0)) for name in ("command_latency", "lateness"))
    return BagEvaluation(
        record=record,
        expected_samples=_taken(encoder),
        received_samples=len(encoder),
        lost_references=_missing(encoder, reference),
        lost_commands=_missing(encoder, command),
        latency=latency[np.isfinite(latency)],
        lateness=lateness[np.isfinite(lateness)],
        stamps=encoder,
        amplifier_on=np.isfinite(streams[ENCODER.topic].columns["coil_current"][encoder_rows]),
        parameters=parameters,
    )


def _unique(stream: StreamColumns) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Stamps in order, without repetitions (lockstep repeats a sample that got no answer), and their rows."""
    return np.unique(stream.stamp, return_index=True)


def _taken(stamps: NDArray[np.int64]) -> int:
    """Samples from the first of these to the last. They are counted from one to the next: the stamps of a board with a
    quartz of its own lie on no grid for a whole run."""
    steps = np.diff(stamps)
    return 1 + int(np.maximum(1, np.round(steps / np.median(steps))).sum())


def _missing(samples: NDArray[np.int64], answers: NDArray[np.int64]) -> int:
    """Samples up to the last answered one that have no answer."""
    inside = samples[samples <= answers[-1]]
    return int(np.count_nonzero(~np.isin(inside, answers)))
