"""What a bag says of a run: the record of the stroke, the counts of its samples, the loop's latency."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.bags import PARAMETERS_ATTACHMENT, BagError
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams
from straightcomp_ros.configuration import read_parameter_tree
from straightcomp_ros.contract import COMMAND, DRIVER_STATE, ENCODER, REFERENCE, STREAMS, TRUTH


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
    """

    record: StrokeRecord
    expected_samples: int
    received_samples: int
    lost_references: int
    lost_commands: int
    latency: NDArray[np.float64]

    @property
    def lost_samples(self) -> int:
        """Samples that the clock took and the bag does not have."""
        return self.expected_samples - self.received_samples

    def latency_us(self, percentile: float) -> float:
        """Percentile of the latency in µs; NaN if none was recorded."""
        return float(np.percentile(self.latency, percentile)) * 1e6 if len(self.latency) else math.nan


def evaluate_bag(bag: Path) -> BagEvaluation:
    """Read a bag of the graph and put the streams together by their stamps.

    Raises:
        BagError: the bag cannot be read, or lacks encoder, reference or command.
    """
    streams = read_streams(bag, {stream.topic: stream.layout for stream in STREAMS})
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
        law=recorded_law(bag),
    )
    period_ns = float(np.median(np.diff(encoder)))
    latency = streams[DRIVER_STATE.topic].columns["command_latency"] if DRIVER_STATE.topic in streams else np.empty(0)
    return BagEvaluation(
        record=record,
        expected_samples=round((encoder[-1] - encoder[0]) / period_ns) + 1,
        received_samples=len(encoder),
        lost_references=_missing(encoder, reference),
        lost_commands=_missing(encoder, command),
        latency=latency[np.isfinite(latency)],
    )


def recorded_law(bag: Path) -> str:
    """Name of the control law in the bag's parameters, or ``unknown``."""
    attachment = read_attachments(bag).get(PARAMETERS_ATTACHMENT, b"")
    values = read_parameter_tree(yaml.safe_load(attachment) or {}, f"bag {bag}: {PARAMETERS_ATTACHMENT}")
    return str(values["controller"].get("control.law", "unknown"))


def _unique(stream: StreamColumns) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Stamps in order, without repetitions (lockstep repeats a sample that got no answer), and their rows."""
    return np.unique(stream.stamp, return_index=True)


def _missing(samples: NDArray[np.int64], answers: NDArray[np.int64]) -> int:
    """Samples up to the last answered one that have no answer."""
    inside = samples[samples <= answers[-1]]
    return int(np.count_nonzero(~np.isin(inside, answers)))
