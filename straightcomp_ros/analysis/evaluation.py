"""The run in a bag: the record of its strokes, the counts of its samples, the loop's latency."""

import contextlib
import math
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.interruption import (
    ENDS_APART,
    PAUSE,
    EncoderRun,
    LatchedFault,
    Stall,
    clock_jump,
    encoder_run,
    interruption,
    latched_faults,
    stalls_of,
)
from straightcomp_ros.analysis.record import MetricsError, StrokeRecord, motion_of
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.fields import FieldValues
from straightcomp_ros.bags.folder import opened, topic_names
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.reader import Messages, StreamColumns, attachments_of, streams_of
from straightcomp_ros.bags.recorded_nodes import recorded_parameters, reports_in, unpacked_map
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import COMMAND, DIAGNOSTICS, DISPLACEMENT, DRIVER_STATE, ENCODER, REFERENCE, TRUTH
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey import SurveyError
from straightcomp_ros.timing.node_timing import Report


def attached_map(
    attachments: Mapping[str, bytes], parameters: Mapping[str, Mapping[str, Any]]
) -> StraightnessMap | None:
    """The map of the attached survey; None without one, or where it makes no map by the recorded parameters."""
    section = parameters.get("feedforward", {})
    own = {
        name.removeprefix("stage.guide."): value for name, value in section.items() if name.startswith("stage.guide.")
    }
    with tempfile.TemporaryDirectory() as folder:
        survey = unpacked_map(attachments, Path(folder))
        if survey is None:
            return None
        try:
            return load_map(from_mapping(MapParameters, {**own, "file": str(survey)}))
        except (ParameterError, SurveyError):
            return None


FOR_EVER = int(np.iinfo(np.int64).max)
"""The last stamp, ns."""


@dataclass(frozen=True)
class BagEvaluation:
    """A recorded run.

    Attributes:
        record: the samples of the run that have sample, reference and command (and truth, in a simulation). The run
            begins when the amplifier is switched on, after discovery, or with the bag if the amplifier is never on.
        expected_samples: samples that the sampling clock took from the run's first to its last in the bag.
        received_samples: different samples of the run in the bag.
        lost_references, lost_commands: samples of the run without one, up to the last that has one, or to the last of
            the motion if the recording goes on after that.
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
        latency_stamps: stamps in ns of the driver's records that have ``latency``, as many.
        encoder: all samples of the run, as the encoder saw the stage move; None for a run that was not recorded.
        reports: what each node reported in its diagnostics, by its name.
        faults: that were latched in the run, or after it.
        clock_jump: where the clock of the stamps jumped, in words; empty if it ran on.
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
    encoder: EncoderRun | None = None
    reports: Mapping[str, Sequence[Report]] = field(default_factory=dict)
    faults: tuple[LatchedFault, ...] = ()
    clock_jump: str = ""

    def interruption(self, begin_ns: int = 0, until_ns: int = FOR_EVER) -> str:
        """Why the law did not run for the whole motion, or that from ``begin_ns`` to before ``until_ns``."""
        return interruption(self.encoder, self.faults, begin_ns, until_ns) if self.encoder else ""

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
    diagnostics = Messages(DIAGNOSTICS)
    with opened(bag) as files:
        streams = streams_of(bag, files, {stream.topic: stream.layout for stream in wanted}, remap, [diagnostics])
        attachments = attachments_of(files)
        encoder_topic = resolved((remap or {}).get(ENCODER.topic, ENCODER.topic), topic_names(files), str(bag))
        finished = all(file.summary is not None for file in files if isinstance(file, McapInput))
    try:
        reports = reports_in(bag, diagnostics, encoder_topic)
    except BagError as error:
        # Every node of a machine reports there: others' messages do not make a run's samples unreadable.
        warnings.warn(f"faults of the run are not known: {error}", stacklevel=2)
        reports = {}
    parameters = recorded_parameters(bag, attachments)
    for stream in (ENCODER, REFERENCE, COMMAND):
        if stream.topic not in streams or len(streams[stream.topic].stamp) < 2:
            raise BagError(f"bag {bag}: has no messages on '{stream.topic}'; was the whole graph running?")
    jump, driver = clock_jump(streams[ENCODER.topic]), streams.get(DRIVER_STATE.topic)
    unique = {topic: stream.by_stamp() for topic, stream in streams.items()}
    samples, reference, command, truth = (unique.get(one.topic) for one in (ENCODER, REFERENCE, COMMAND, TRUTH))
    assert samples and reference and command
    on = np.isfinite(samples.columns["coil_current"])
    first = int(on.argmax())
    encoder, x, on = samples.stamp[first:], samples.columns["x"][first:], on[first:]
    common = encoder
    for own in (reference, command, *([truth] if truth else [])):
        common = np.intersect1d(common, own.stamp, assume_unique=True)
    if len(common) < 2:
        raise BagError(f"bag {bag}: its streams do not belong together: they have no common stamps")
    if (np.diff(common) >= PAUSE * 1e9).any():
        common = common[_judged(common, x[np.searchsorted(encoder, common)])]

    def column(stream: StreamColumns, name: str) -> NDArray[np.float64]:
        return stream.columns[name][np.searchsorted(stream.stamp, common)]

    record = StrokeRecord(
        time=(common - common[0]) * 1e-9,
        x=column(samples, "x"),
        y=column(samples, "y"),
        r=column(reference, "r"),
        current=column(command, "control_current"),
        true_x=column(truth, "true_x") if truth else None,
        true_y=column(truth, "true_y") if truth else None,
        guide=column(truth, "guide_deviation") if truth else None,
        law=str(parameters.get("controller", {}).get("control.law", "unknown")),
    )
    guide, sensor = None, unique.get(DISPLACEMENT.topic)
    if sensor and len(sensor) > 1:
        values, known = FieldValues(sensor.stamp, sensor.columns["deviation"], True).at(common)
        guide = np.where(known, values, np.nan)
    columns = driver.columns if driver else {}
    latency, lateness = (columns.get(name, np.empty(0)) for name in ("command_latency", "lateness"))
    state = driver.stamp if driver else encoder[:0]
    recorded = np.isfinite(latency)
    answers = max(int(reference.stamp[-1]), int(command.stamp[-1]))
    reported = max((own[-1].time_ns for own in reports.values()), default=0)
    for pause in np.flatnonzero(np.diff(encoder) >= PAUSE * 1e9).tolist():
        begin, end = ((int(encoder[at]) - int(encoder[0])) * 1e-9 for at in (pause, pause + 1))
        warnings.warn(f"the recording was paused for {end - begin:.6g} s after {begin:.6g} s", stacklevel=2)
    run = encoder_run(
        encoder,
        x,
        on,
        int(common[-1]),
        goes_on=answers > encoder[-1] or reported > encoder[-1] + ENDS_APART * 1e9,
        silent=not finished or reported > encoder[-1] + PAUSE * 1e9,
    )
    stalls = stalls_of(encoder - common[0], command.stamp - common[0], state - common[0], columns)
    return BagEvaluation(
        record=record,
        expected_samples=samples_taken(encoder),
        received_samples=len(encoder),
        lost_references=_missing(run, reference.stamp),
        lost_commands=_missing(run, command.stamp),
        latency=latency[recorded],
        lateness=lateness[np.isfinite(lateness)],
        stamps=encoder,
        amplifier_on=on,
        parameters=parameters,
        map=attached_map(attachments, parameters),
        stalls=tuple(stalls),
        begin_ns=int(common[0]),
        coil_current=column(samples, "coil_current"),
        guide=guide,
        latency_stamps=state[recorded],
        encoder=run,
        reports=reports,
        faults=latched_faults(reports, int(encoder[0])),
        clock_jump=jump,
    )


def _judged(stamps: NDArray[np.int64], x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The samples (n,) to judge: all but those at rest on both sides of a pause of the recording, in which the platform
    may have been anywhere."""
    judged = np.ones(stamps.size, np.bool_)
    pauses = np.flatnonzero(np.diff(stamps) >= PAUSE * 1e9) + 1
    if np.isfinite(x).all():
        with contextlib.suppress(MetricsError):
            strokes = motion_of((stamps - stamps[0]) * 1e-9, x).strokes
            begins, ends = (np.array([getattr(one, name) for one in strokes]) for name in ("start", "stop"))
            for pause in pauses:
                before, after = ends[begins < pause], begins[begins >= pause]
                if before.size and after.size and before[-1] <= pause:
                    judged[before[-1] : after[0]] = False
    return judged


def samples_taken(stamps: NDArray[np.int64]) -> int:
    """Samples that the clock took from the first of these stamps (n,) in ns to the last, counted from one to the next:
    the stamps of a board with a clock of its own lie on no common grid for a whole run. In a pause of the recording
    none counts."""
    steps = np.diff(stamps)
    taken = np.maximum(1, np.round(steps / np.median(steps)))
    return 1 + int(np.where(steps < PAUSE * 1e9, taken, 1).sum())


def _missing(run: EncoderRun, answers: NDArray[np.int64]) -> int:
    """Samples up to the last that had to be answered, or was, that have no answer."""
    inside = run.stamps[run.stamps <= max(int(answers[-1]), run.end_ns)]
    return int(np.count_nonzero(~np.isin(inside, answers)))
