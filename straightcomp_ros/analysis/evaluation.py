"""The run in a bag: the record of its strokes, the counts of its samples, the loop's latency."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.attached_map import attached_map
from straightcomp_ros.analysis.host_stalls import Stall, stalls_of
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.survey_series import values_at
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.fields import FieldValues
from straightcomp_ros.bags.reader import StreamColumns, read_attachments, read_streams
from straightcomp_ros.bags.recorded_parameters import recorded_parameters
from straightcomp_ros.contract import COMMAND, DISPLACEMENT, DRIVER_STATE, ENCODER, REFERENCE, TRUTH, Stream
from straightcomp_ros.straightness.guide_map import StraightnessMap


@dataclass(frozen=True)
class BagEvaluation:
    """A recorded run.

    Attributes:
        record: the samples of the run that have sample, reference and command (and truth, in a simulation). The run
            begins when the amplifier is switched on, after discovery, or with the bag if the amplifier is never on.
        expected_samples: samples that the sampling clock took from the run's first to its last in the bag.
        received_samples: different samples of the run in the bag.
        lost_references, lost_commands: samples of the run without one, up to the last that has one.
        latency: times in s from a sample to the arrival of its command at the driver, as far as recorded.
        lateness: times in s from a sample until the driver published it, as far as recorded.
        stamps: (n,) ns, the run's different samples in the bag, in order; those of ``record`` are among them.
        amplifier_on: (n,) for the same samples.
        parameters: of the recorded nodes, by node and dotted name; empty when none are attached.
        map: of the attached survey; None without one.
        stalls: when the host failed the loop, on the clock of ``record``.
        begin_ns: stamp of the first sample of ``record``.
        coil_current: (m,) measured control current of the coils in A at the samples of ``record``; NaN without it.
        guide: (m,) m, the guide's deviation by the displacement sensor at the samples of ``record``, up to a constant,
            NaN where it was not recorded; None without a sensor.
        latency_stamps: stamps in ns of the driver's records that tell ``latency``, as many.
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
    map: StraightnessMap | None = None
    stalls: tuple[Stall, ...] = ()
    begin_ns: int = 0
    coil_current: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    guide: NDArray[np.float64] | None = None
    latency_stamps: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def lost_samples(self) -> int:
        """Samples that the clock took and the bag does not have."""
        return self.expected_samples - self.received_samples

    def latency_us(self, percentile: float) -> float:
        """Percentile of the latency in µs; NaN if none was recorded."""
        return percentile_us(self.latency, percentile)


def percentile_us(durations: NDArray[np.float64], percentile: float) -> float:
    """Percentile in µs of durations in s; NaN if there are none."""
    return float(np.percentile(durations, percentile)) * 1e6 if len(durations) else math.nan


def evaluate_bag(bag: Path, remap: Mapping[str, str] | None = None) -> BagEvaluation:
    """Read a bag of the graph, a rosbag2 folder or MCAP file, and join its streams by their stamps.

    ``remap`` has the bag's topic for each of ours that has another name there.

    Raises:
        BagError: the bag cannot be read, or lacks encoder, reference or command.
    """
    wanted = (ENCODER, REFERENCE, COMMAND, DRIVER_STATE, TRUTH, DISPLACEMENT)
    streams = read_streams(bag, {stream.topic: stream.layout for stream in wanted}, remap)
    attachments = read_attachments(bag)
    parameters = recorded_parameters(bag, attachments)
    for stream in (ENCODER, REFERENCE, COMMAND):
        if stream.topic not in streams or len(streams[stream.topic].stamp) < 2:
            raise BagError(f"bag {bag}: has no messages on '{stream.topic}'; was the whole graph running?")
    # By stamp and without repetitions: lockstep repeats a sample that got no answer.
    unique = {topic: np.unique(stream.stamp, return_index=True) for topic, stream in streams.items()}
    encoder, rows = unique[ENCODER.topic]
    on = np.isfinite(streams[ENCODER.topic].columns["coil_current"][rows])
    first = int(on.argmax())
    encoder, rows, on = encoder[first:], rows[first:], on[first:]
    unique[ENCODER.topic] = encoder, rows
    common = encoder
    for stream in (REFERENCE, COMMAND, TRUTH):
        if stream.topic in unique:
            common = np.intersect1d(common, unique[stream.topic][0], assume_unique=True)
    if len(common) < 2:
        raise BagError(f"bag {bag}: its streams do not belong together: they have no common stamps")

    def column(stream: Stream, name: str) -> NDArray[np.float64]:
        stamps, rows = unique[stream.topic]
        return streams[stream.topic].columns[name][rows[np.searchsorted(stamps, common)]]

    known = ("true_x", "true_y", "guide_deviation") if TRUTH.topic in streams else ()
    truth = {name: column(TRUTH, name) for name in known}
    record = StrokeRecord(
        time=(common - common[0]) * 1e-9,
        x=column(ENCODER, "x"),
        y=column(ENCODER, "y"),
        r=column(REFERENCE, "r"),
        current=column(COMMAND, "control_current"),
        true_x=truth.get("true_x"),
        true_y=truth.get("true_y"),
        guide=truth.get("guide_deviation"),
        law=str(parameters.get("controller", {}).get("control.law", "unknown")),
    )
    driver = streams.get(DRIVER_STATE.topic)
    columns = driver.columns if driver else {}
    latency, lateness = (columns.get(name, np.empty(0)) for name in ("command_latency", "lateness"))
    answered = unique[COMMAND.topic][0]
    state = driver.stamp if driver else answered[:0]
    told = np.isfinite(latency)
    stalls = stalls_of(encoder - common[0], answered - common[0], state - common[0], columns)
    return BagEvaluation(
        record=record,
        expected_samples=samples_taken(encoder),
        received_samples=len(encoder),
        lost_references=_missing(encoder, unique[REFERENCE.topic][0]),
        lost_commands=_missing(encoder, answered),
        latency=latency[told],
        lateness=lateness[np.isfinite(lateness)],
        stamps=encoder,
        amplifier_on=on,
        parameters=parameters,
        map=attached_map(attachments, parameters),
        stalls=tuple(stalls),
        begin_ns=int(common[0]),
        coil_current=column(ENCODER, "coil_current"),
        guide=_guide(streams, unique, common),
        latency_stamps=state[told],
    )


def _guide(
    streams: Mapping[str, StreamColumns], unique: Mapping[str, Sequence[NDArray[Any]]], at: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    topic = DISPLACEMENT.topic
    if topic not in streams or len(unique[topic][0]) < 2:
        return None
    stamps, rows = unique[topic]
    readings = FieldValues(stamps, streams[topic].columns["deviation"][rows], True)
    values, known = values_at(readings, at)
    return np.where(known, values, np.nan)


def samples_taken(stamps: NDArray[np.int64]) -> int:
    """Samples that the clock took from the first of these stamps (n,) in ns to the last, counted from one to the next:
    the stamps of a board with a clock of its own lie on no common grid for a whole run."""
    steps = np.diff(stamps)
    return 1 + int(np.maximum(1, np.round(steps / np.median(steps))).sum())


def _missing(samples: NDArray[np.int64], answers: NDArray[np.int64]) -> int:
    """Samples up to the last answered one that have no answer."""
    inside = samples[samples <= answers[-1]]
    return int(np.count_nonzero(~np.isin(inside, answers)))
