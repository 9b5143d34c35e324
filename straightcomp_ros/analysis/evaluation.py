"""The run in a bag: the record of its strokes, the counts of its samples, the loop's latency."""

import contextlib
import math
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis import interruption
from straightcomp_ros.analysis.interruption import ENDS_APART, PAUSE, EncoderRun, LatchedFault, Stall, Stamps
from straightcomp_ros.analysis.judged_motion import HARM, encoder_count, recorded_limit
from straightcomp_ros.analysis.judgement import CLOCK_JUMPED, INTERRUPTED, STARVED, Verdict
from straightcomp_ros.analysis.record import AT_LIMIT, Array, MetricsError, StrokeRecord, motion_of, speed_at_end
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.fields import FieldValues
from straightcomp_ros.bags.folder import BagInput, opened, topic_names
from straightcomp_ros.bags.reader import Messages, StreamColumns, attachments_of, streams_of_stage, values_at
from straightcomp_ros.bags.recorded_nodes import (
    noted_changes,
    recorded_parameters,
    reports_in,
    topic_of_reports,
    unpacked_map,
)
from straightcomp_ros.bags.recovery import LOST_FILES, RECOVERY_METADATA, UNFINISHED_FILES
from straightcomp_ros.bags.topics import resolved
from straightcomp_ros.contract import COMMAND, DIAGNOSTICS, DISPLACEMENT, DRIVER_STATE, ENCODER, REFERENCE, TRUTH
from straightcomp_ros.parameters.declaration import ParameterError, declarations, from_mapping, under
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.timing.node_timing import Report


def attached_map(
    attachments: Mapping[str, bytes], parameters: Mapping[str, Mapping[str, Any]]
) -> StraightnessMap | None:
    """The map of the attached survey; None without one, or where it makes no map by the recorded parameters."""
    with tempfile.TemporaryDirectory() as folder:
        survey = unpacked_map(attachments, Path(folder))
        if survey is None:
            return None
        try:
            # Recordings without these are older: their reference went through every point of the mean.
            older = {"smooth": "none", "direction": "mean"}
            recorded = under("stage.guide.", parameters.get("feedforward", {}))
            return load_map(from_mapping(MapParameters, {**older, **recorded, "file": str(survey)}))
        except (ParameterError, SurveyError):
            return None


_OTHER_RATE = 0.02
"""Deviation of the stamps' rate from the described one that is no clock's: crystals differ by less than 0.001."""
_SEEN = 0.5
"""Fraction of the travel that must be in the record: a small error of less than that says nothing of the rest."""
_NAMED = 5
"""Changed parameters that a warning names."""
_ORDERS = ("driver.override", "driver.blend")
"""Parameters by which a motion is asked for: what the stage did is in the samples."""
_TRUTH = {"true_x": "true_x", "true_y": "true_y", "guide": "guide_deviation"}
"""Columns of the truth by those of a record."""
FOR_EVER = int(np.iinfo(np.int64).max)
"""The last stamp, ns."""


@dataclass(frozen=True)
class BagEvaluation:
    """A recorded run. It begins when the amplifier is switched on, after discovery, or with the bag if the amplifier is
    never on. Latency is the time from a sample to the arrival of its command at the driver, lateness that until the
    driver published it; both in s, as far as recorded."""

    record: StrokeRecord  # the samples that have sample, reference and command (and truth, in a simulation)
    # Samples without one, up to the last that has one, or to the last of the motion if the recording goes on.
    lost_references: int
    lost_commands: int
    latency: Array
    lateness: Array
    stamps: Stamps  # (n,) ns, the run's different samples in the bag, in order; those of the record are among them
    amplifier_on: NDArray[np.bool_]  # (n,) for the same samples
    parameters: Mapping[str, Mapping[str, Any]]  # of the recorded nodes, by node and dotted name; empty without any
    encoder: EncoderRun  # as the encoder saw the stage move
    map: StraightnessMap | None = None  # of the attached survey
    stalls: tuple[Stall, ...] = ()  # when the host failed the loop, on the clock of the record
    begin_ns: int = 0  # stamp of the first sample of the record
    # (m,) measured control current of the coils in A at the samples of the record; NaN without it.
    coil_current: Array = field(default_factory=lambda: np.empty(0))
    # (m,) m, the guide's deviation by the displacement sensor at the same samples, up to a constant, NaN where it was
    # not recorded; None without a sensor.
    guide: Array | None = None
    read: NDArray[np.bool_] | bool = True  # (m,) at which of them it read: between them is interpolation
    # Stamps in ns of the driver's records that have a latency, as many.
    latency_stamps: Stamps = field(default_factory=lambda: np.empty(0, np.int64))
    # (n,) m, r − y of its samples, NaN where r is not known.
    seen_error: Array = field(default_factory=lambda: np.empty(0))
    reports: Mapping[str, Sequence[Report]] = field(default_factory=dict)  # each node's diagnostics
    faults: tuple[LatchedFault, ...] = ()  # that were latched in the run, or after it
    lost_files: str = ""  # names of the recording's files that could not be recovered
    clock_jump: str = ""  # where the clock of the stamps jumped, in words; empty if it ran on

    @property
    def expected_samples(self) -> int:
        """Samples that the clock took from the run's first to its last in the bag."""
        return samples_taken(self.stamps, self.pauses)

    @property
    def pauses(self) -> Stamps:
        """Stamps (p,) in ns of the last sample before each pause of the recording."""
        return self.encoder.pauses

    @property
    def received_samples(self) -> int:
        """Different samples of the run in the bag."""
        return len(self.stamps)

    @property
    def lost_samples(self) -> int:
        """Samples that the clock took and the bag does not have."""
        return self.expected_samples - self.received_samples

    @cached_property
    def count(self) -> float:
        """One count of the encoder of y in m, as its readings show it."""
        return encoder_count(self.record.y)

    @cached_property
    def record_stamps(self) -> Stamps:
        """Of the record's samples (m,), ns. Its times in s are rounded to more than that after 104 days."""
        near = self.begin_ns + np.round(self.record.time * 1e9).astype(np.int64)
        return self.stamps[np.searchsorted(self.stamps[:-1] + np.diff(self.stamps) // 2, near)]

    @property
    def readings(self) -> Array | None:
        """The sensor's, each at the sample nearest to it; NaN at the others."""
        return None if self.guide is None else np.where(self.read, self.guide, np.nan)

    @cached_property
    def at_current_limit(self) -> NDArray[np.bool_]:
        """The samples (m,) of the record with the command at the law's limit; none where that was not recorded."""
        controller = self.parameters.get("controller")
        limit = recorded_limit(controller) if controller else math.inf
        return np.asarray(np.abs(self.record.current) >= AT_LIMIT * limit)

    def partial(self, begin_ns: int = 0, until_ns: int = FOR_EVER) -> Verdict | None:
        """The verdict on a run whose figures are those of a part of its motion, or of that from ``begin_ns`` to before
        ``until_ns``; None for a whole one."""
        if self.clock_jump:
            remedy = "record again, with a driver whose stamps come from a monotonic clock"
            return Verdict(CLOCK_JUMPED, f"{self.clock_jump}; {remedy}")
        if self.lost_files:
            return Verdict(INTERRUPTED, f"{self.lost_files} could not be recovered; the figures are those of the rest")
        if reason := self.encoder.interruption(self.faults, begin_ns, until_ns, self.begin_ns):
            return Verdict(INTERRUPTED, f"{reason}; the figures are those of a part of the motion")
        if reason := self._unjudged_harm(begin_ns, until_ns):
            return Verdict(STARVED, f"the computer was busy: {reason}")
        reason = self._too_little(begin_ns, until_ns)
        return Verdict(STARVED, f"too little was recorded to judge: {reason}") if reason else None

    def _too_little(self, begin_ns: int, until_ns: int) -> str:
        """That less than half of the travel is in the record: in its gaps the error is not known, and of a stream that
        is thinner than the encoder's it is another one. Empty if the record has more."""
        stamps = self.record_stamps
        moving = self.encoder.moving(begin_ns, until_ns)[np.searchsorted(self.encoder.stamps, stamps)]
        travelled = np.abs(np.diff(self.record.x))[moving[:-1] & moving[1:]]
        taken = samples_between(stamps, self.encoder.stamps)[moving[:-1] & moving[1:]]
        seen, whole = float((travelled / taken).sum()), float(travelled.sum())
        if not seen < _SEEN * whole:
            return ""
        without = f"without reference: {self.lost_references}, without command: {self.lost_commands}"
        return (
            f"{seen / whole:.0%} of the travel is in samples with all of their streams; allowed: {_SEEN:.0%} (samples "
            f"lost: {self.lost_samples}, {without}); record every message of each stream"
        )

    def _unjudged_harm(self, begin_ns: int, until_ns: int) -> str:
        """How the samples in motion that are not in the record, for want of reference, command or truth, enlarge the
        error as the encoders see it; empty if they do not."""
        if not self.seen_error.size:
            return ""
        stamps = self.encoder.stamps
        moving = self.encoder.moving(begin_ns, until_ns) & np.isfinite(self.seen_error)
        judged = np.isin(stamps, self.record_stamps)
        # Streams that are stopped in motion end some samples apart.
        left = moving & ~judged & (stamps < self.encoder.judged_ns)
        if not left.any() or not (moving & judged).any():
            return ""
        usual, whole = (float(np.ptp(self.seen_error[of])) for of in (moving & judged, moving & (judged | left)))
        if whole <= HARM * usual or whole - usual <= self.count:
            return ""
        since = float(stamps[left.argmax()] - self.begin_ns) * 1e-9
        samples = f"{np.count_nonzero(left)} samples of the motion, from {since:.3f} s on,"
        made = f"the error is {whole * 1e6:.3g} µm p-p in place of {usual * 1e6:.3g}; allowed: {HARM:g} times"
        return f"{samples} lack reference, command or truth, and with them {made}; the figures are those without them"


def percentile_us(durations: Array, percentile: float) -> float:
    """Percentile in µs of durations in s; NaN if there are none."""
    return float(np.percentile(durations, percentile)) * 1e6 if len(durations) else math.nan


def _sensor(bag: Path, files: Sequence[BagInput], remap: Mapping[str, str] | None) -> dict[str, StreamColumns]:
    """The stream of the displacement sensor of the encoder's stage, if the bag has it."""
    try:
        return streams_of_stage(bag, files, [DISPLACEMENT], remap)
    except BagError as error:
        # The node of a survey is the user's, and may name its joint otherwise: the run can be judged without it.
        warnings.warn(f"the displacement sensor is left out: {error}", stacklevel=3)
    return {}


def evaluate_bag(bag: Path, remap: Mapping[str, str] | None = None) -> BagEvaluation:
    """Read a bag of the graph, a rosbag2 folder or MCAP file, and join its streams by their stamps.

    ``remap`` has the bag's topic for each of ours that has another name there. Of several stages in the bag that of the
    encoder is taken.

    Raises:
        BagError: the bag cannot be read, or lacks encoder, reference or command.
    """
    needed = (ENCODER, REFERENCE, COMMAND)
    with opened(bag) as files:
        names = topic_names(files)
        encoder_topic = resolved((remap or {}).get(ENCODER.topic, ENCODER.topic), names, str(bag))
        diagnostics = Messages(topic_of_reports(bag, names, encoder_topic or ENCODER.topic) or DIAGNOSTICS)
        streams = streams_of_stage(bag, files, (*needed, DRIVER_STATE, TRUTH), remap, [diagnostics])
        streams |= _sensor(bag, files, remap)
        attachments = attachments_of(files)
        recovery = [one.metadata for file in files for one in file.metadata() if one.name == RECOVERY_METADATA]
        changed = {
            name: value for _, values in noted_changes(files) for name, value in values.items() if name not in _ORDERS
        }
        # What was recovered of a recording that was cut off ends where that does.
        finished = all(file.finished for file in files) and not any(one.get(UNFINISHED_FILES) for one in recovery)
    try:
        reports = reports_in(bag, diagnostics, encoder_topic)
    except BagError as error:
        # Every node of a machine reports there: others' messages do not make a run's samples unreadable.
        warnings.warn(f"faults of the run are not known: {error}", stacklevel=2)
        reports = {}
    parameters = recorded_parameters(bag, attachments, remap)
    if changed:
        some = ", ".join(f"'{name}' {value}" for name, value in list(changed.items())[:_NAMED])
        more = f" and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
        warnings.warn(
            f"parameters changed while the bag was recorded: {some}{more}; judged by the former", stacklevel=2
        )
    _check_numbers(bag, parameters)
    for stream in needed:
        if stream.topic not in streams or len(streams[stream.topic].stamp) < 2:
            why = "was the whole graph running, under these names (--remap)?"
            raise BagError(f"bag {bag}: has no messages on '{stream.topic}'; {why}")
    # In lockstep stamps follow no clock, and on a busy computer those of recording and reports run away from them.
    lockstep = parameters.get("driver", {}).get("lockstep", False)
    jump = "" if lockstep else interruption.clock_jump(streams[ENCODER.topic])
    driver = streams.get(DRIVER_STATE.topic)
    unique = {topic: stream.by_stamp() for topic, stream in streams.items()}
    samples, reference, command, truth = (unique.get(one.topic) for one in (ENCODER, REFERENCE, COMMAND, TRUTH))
    assert samples and reference and command
    on = np.isfinite(samples.columns["coil_current"])
    first = int(on.argmax())
    before = np.flatnonzero(np.isfinite(samples.columns["x"][: first + 1]))
    on_at = speed_at_end((samples.stamp[before] - samples.stamp[0]) * 1e-9, samples.columns["x"][before])
    encoder, x, on = samples.stamp[first:], samples.columns["x"][first:], on[first:]
    if truth and len(truth) > 1 and np.median(np.diff(truth.stamp)) > 1.5 * np.median(np.diff(encoder)):
        count = f"{len(truth)} messages for {len(samples)} samples"
        warnings.warn(f"'{TRUTH.topic}' has {count}: it is left out, the run is judged by its encoders", stacklevel=2)
        truth = None
    common = encoder
    for own in (reference, command, *([truth] if truth else [])):
        common = np.intersect1d(common, own.stamp, assume_unique=True)
    if len(common) < 2:
        raise BagError(f"bag {bag}: its streams do not belong together: they have no common stamps")
    rate, measured = parameters.get("driver", {}).get("stage.rate"), 1e9 / np.median(np.diff(encoder))
    if rate and abs(measured - rate) > _OTHER_RATE * measured:
        text = f"samples came {measured:.6g} times a second, the run's parameter 'stage.rate' says {rate:g} Hz"
        warnings.warn(f"{text}: times, speeds and frequencies are by the stamps", stacklevel=2)
    if (np.diff(common) >= PAUSE * 1e9).any():
        common = common[_judged(common, x[np.searchsorted(encoder, common)])]

    def column(stream: StreamColumns, name: str) -> Array:
        return stream.columns[name][np.searchsorted(stream.stamp, common)]

    record = StrokeRecord(
        time=(common - common[0]) * 1e-9,
        x=column(samples, "x"),
        y=column(samples, "y"),
        r=column(reference, "r"),
        current=column(command, "control_current"),
        law=str(parameters.get("controller", {}).get("control.law", "unknown")),
        **({name: column(truth, theirs) for name, theirs in _TRUTH.items()} if truth else {}),
    )
    guide, read = _guide_by(unique.get(DISPLACEMENT.topic), common)
    columns = driver.columns if driver else {}
    latency, lateness = (columns.get(name, np.empty(0)) for name in ("command_latency", "lateness"))
    state = driver.stamp if driver else encoder[:0]
    recorded = np.isfinite(latency)
    answering = {"reference": reference, "command": command} | ({"truth": truth} if truth else {})
    last = {name: int(own.stamp[-1]) for name, own in answering.items()}
    ended = [name for name, stamp in last.items() if stamp <= min(last.values()) + ENDS_APART * 1e9]
    answers = max(int(reference.stamp[-1]), int(command.stamp[-1]))
    reported = 0 if lockstep else max((own[-1].time_ns for own in reports.values()), default=0)
    run = interruption.encoder_run(
        encoder,
        x,
        on,
        int(common[-1]),
        goes_on=answers > encoder[-1] or reported > encoder[-1] + ENDS_APART * 1e9,
        silent=not finished or reported > encoder[-1] + PAUSE * 1e9,
        ended=" and ".join(ended),
        on_at=on_at,
    )
    for pause in np.searchsorted(encoder, run.pauses).tolist():
        begin, end = ((int(encoder[at]) - int(common[0])) * 1e-9 for at in (pause, pause + 1))
        warnings.warn(f"the recording was paused for {end - begin:.6g} s after {begin:.6g} s", stacklevel=2)
    straightness = attached_map(attachments, parameters)
    stalls = interruption.stalls_of(encoder - common[0], command.stamp - common[0], state - common[0], columns)
    return BagEvaluation(
        record=record,
        lost_references=run.unanswered(reference.stamp),
        lost_commands=run.unanswered(command.stamp),
        latency=latency[recorded],
        lateness=lateness[np.isfinite(lateness)],
        stamps=encoder,
        amplifier_on=on,
        parameters=parameters,
        map=straightness,
        stalls=tuple(stalls),
        begin_ns=int(common[0]),
        coil_current=column(samples, "coil_current"),
        guide=guide,
        read=read,
        latency_stamps=state[recorded],
        encoder=run,
        seen_error=_reference_at(encoder, x, reference, record, straightness) - samples.columns["y"][first:],
        reports=reports,
        faults=interruption.latched_faults(reports, int(encoder[0])),
        lost_files=", ".join(name for one in recovery if (name := one.get(LOST_FILES))),
        clock_jump=jump,
    )


def _guide_by(sensor: StreamColumns | None, stamps: Stamps) -> tuple[Array | None, NDArray[np.bool_]]:
    """``guide`` and ``read`` of a :class:`BagEvaluation` by the displacement sensor, at ``stamps`` (m,)."""
    read = np.full(stamps.size, sensor is None)
    if sensor is None or len(sensor) < 2:
        return None, read
    values, known = FieldValues(sensor.stamp, sensor.columns["deviation"], True).at(stamps)
    nearest = np.searchsorted(stamps[:-1] + np.diff(stamps) // 2, sensor.stamp)
    close = np.abs(sensor.stamp - stamps[nearest]) <= np.median(np.diff(stamps))
    values[nearest[close]], read[nearest[close]] = sensor.columns["deviation"][close], True
    return np.where(known | read, values, np.nan), read


def _reference_at(
    stamps: Stamps, x: Array, reference: StreamColumns, run: StrokeRecord, straightness: StraightnessMap | None
) -> Array:
    """r (n,) in m at these samples: as recorded, else by the map, or by what the ``run`` recorded at the same x; NaN
    where neither has it."""
    r = values_at(reference, "r", stamps)
    missing = np.isnan(r)
    if straightness and not straightness.directed:
        r[missing] = straightness.evaluate(x[missing])[0]
    elif not run.reference.directed:
        missing &= run.reference.recorded_around(x)
        r[missing] = run.reference.evaluate(x[missing])[0]
    return r


def _check_numbers(bag: Path, parameters: Mapping[str, Mapping[str, Any]]) -> None:
    for node, given in parameters.items():
        for name in _numbers(node) & given.keys():
            value = given[name]
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                why = f"parameters.yaml: '{name}' of node '{node}' is {value!r}; allowed: a finite number"
                raise BagError(f"bag {bag}: {why}; record the bag again")


@cache
def _numbers(node: str) -> frozenset[str]:
    """Names of a node's parameters that are numbers. Their ranges are those of the version that recorded them."""
    known = declarations(NODE_PARAMETERS[node]) if node in NODE_PARAMETERS else ()
    return frozenset(one.name for one in known if one.kind in (int, float))


def _judged(stamps: Stamps, x: Array) -> NDArray[np.bool_]:
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


def samples_taken(stamps: Stamps, pauses: Stamps | Sequence[int] = ()) -> int:
    """Samples that the clock took from the first of these stamps (n,) in ns to the last, counted from one to the next:
    the stamps of a board with a clock of its own lie on no common grid for a whole run. In the pauses of the recording
    behind the samples ``pauses`` (p,), stamps in ns, none counts."""
    taken = samples_between(stamps, stamps)
    return 1 + int(np.where(np.isin(stamps[:-1], pauses), 1, taken).sum())


def samples_between(stamps: Stamps, encoder: Stamps) -> Array:
    """Periods (n - 1,), at least 1, from each of these ``stamps`` (n,) in ns to the next, by those of the encoder."""
    return np.asarray(np.maximum(1.0, np.round(np.diff(stamps) / np.median(np.diff(encoder)))))
