"""The rows of a bag: figures of each of its strokes, by the code of `straightcomp evaluate`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.current_path import Recording, current_path
from straightcomp_ros.analysis.error_detail import stick_slips
from straightcomp_ros.analysis.evaluation import BagEvaluation, percentile_us, samples_taken
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import force_balance, residual_of_stroke, stroke_figures
from straightcomp_ros.analysis.record import RecordedReference, Stroke, StrokeRecord
from straightcomp_ros.analysis.run_verdict import judged_run, recorded_drive
from straightcomp_ros.bags import MAP_ATTACHMENT
from straightcomp_ros.bags.folder import found_files, split_number
from straightcomp_ros.bags.information import ORIGIN_METADATA
from straightcomp_ros.bags.reader import read_attachments, read_metadata
from straightcomp_ros.fleet.history.rows import BIN_MM, StrokeRow, checksum_of, stored_name
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters

_IN_THE_LOOP = ("driver", "feedforward", "controller")
"""Nodes whose parameters have an effect on a stroke. The logger's name each bag's folder."""
_STAGE = "stage."
_WIDTH = 1e-3 * BIN_MM
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_AROUND = 0.05
"""Time in s before and after a stroke that its verdict sees: there its motion is recognised as in the whole run."""


@dataclass(frozen=True)
class Recorded:
    """What a bag says apart from its samples: columns of its rows, and the name of the stage."""

    checksum: str = ""
    bag: str = ""
    stage: str = "unknown"
    identity: str | None = None
    parameters_checksum: str | None = None
    map_checksum: str | None = None
    software_version: str | None = None
    software_revision: str | None = None
    host: str | None = None


@dataclass(frozen=True, eq=False)
class Bins:
    """``count`` bins, the first from x = ``from_mm`` on; ``place`` (n,) is the bin of each sample, beyond 0 to
    ``count`` − 1 for the samples outside."""

    from_mm: int
    count: int
    place: NDArray[np.int64]

    def means(self, values: NDArray[np.float64]) -> list[float | None]:
        """Mean of ``values`` (n,) in each bin, without those that are NaN; None for a bin without a value."""
        inside = (self.place >= 0) & (self.place < self.count) & np.isfinite(values)
        place = self.place[inside]
        samples = np.bincount(place, minlength=self.count)
        sums = np.bincount(place, values[inside], minlength=self.count)
        return [total / n if n else None for total, n in zip(sums.tolist(), samples.tolist(), strict=True)]


def bins_over(x: NDArray[np.float64]) -> Bins:
    """The bins of which a stroke over ``x`` (n,) in m covers at least half: a stroke that begins a count before an edge
    would otherwise have a bin of some samples at rest."""
    first = math.ceil(float(x.min()) / _WIDTH - 0.5)
    last = math.floor(float(x.max()) / _WIDTH + 0.5)
    return Bins(first * BIN_MM, max(last - first, 0), np.floor(x / _WIDTH).astype(np.int64) - first)


def rows_of(evaluation: BagEvaluation, recorded: Recorded) -> list[StrokeRow]:
    """The rows of a run, in the order of its strokes.

    Raises:
        MetricsError: the stage does not move, or a number within the motion is not finite.
    """
    record = evaluation.record
    motion, reference = record.motion, RecordedReference(record)
    record.check_finite(record.columns(), motion.window)
    run = _Run(evaluation, recorded, reference, evaluation.at_current_limit)
    begins = [run.stamp(stroke.start) for stroke in motion.strokes[1:]]
    until = [*begins, np.iinfo(np.int64).max]
    return [run.row(number, *one) for number, one in enumerate(zip(motion.strokes, until, strict=True), 1)]


@dataclass(frozen=True, eq=False)
class _Run:
    evaluation: BagEvaluation
    recorded: Recorded
    reference: RecordedReference
    saturated: NDArray[np.bool_]

    def stamp(self, sample: int) -> int:
        """Stamp in ns of a sample of the record."""
        return self.evaluation.begin_ns + round(float(self.evaluation.record.time[sample]) * 1e9)

    def row(self, number: int, stroke: Stroke, until_ns: int) -> StrokeRow:
        """The row of a stroke; faults until ``until_ns`` are its own."""
        evaluation = self.evaluation
        columns = {name: value for name, value in vars(self.recorded).items() if name != "stage"}
        part = evaluation.record.part(stroke.samples)
        known = part.best_known(self.reference)
        workpiece = residual_of_stroke(part.time, known.x, known.guide + known.y)
        figures = stroke_figures(part, self.reference, stroke.direction).to_display()
        del figures["start_s"]
        begin, end = self.stamp(stroke.start), self.stamp(stroke.stop - 1)
        first, last = np.searchsorted(evaluation.stamps, (begin, end + 1)).tolist()
        stamps = evaluation.stamps[first:last]
        taken = samples_taken(stamps)
        within = (evaluation.latency_stamps >= begin) & (evaluation.latency_stamps <= end)
        latency = evaluation.latency[within]
        verdict = evaluation.partial(begin, until_ns) or self._verdict(stroke)
        bins = bins_over(part.x)
        coils = evaluation.coil_current[stroke.samples]
        balance = force_balance(part.time, part.y, coils)
        return StrokeRow(
            **columns,
            stroke=number,
            start=_EPOCH + timedelta(microseconds=begin // 1000),
            law=part.law,
            **figures,
            control_activity_A=float(np.abs(np.diff(part.current)).sum()),
            coil_work_A2s=_integral(part.time, part.current**2),
            friction_A=_known(balance.friction),
            stiffness_A_per_m=_known(balance.stiffness),
            amplifier_bandwidth_Hz=self._bandwidth(part, coils),
            latency_p50_us=_known(percentile_us(latency, 50)),
            latency_p99_us=_known(percentile_us(latency, 99)),
            expected_samples=taken,
            lost_samples=taken - stamps.size,
            unanswered_samples=stamps.size - part.time.size,
            saturated_samples=int(np.count_nonzero(self.saturated[stroke.samples])),
            amplifier_off_samples=int(np.count_nonzero(~evaluation.amplifier_on[first:last])),
            stick_slip_events=len(stick_slips(part.time, part.x, part.y, part.r)),
            faults=list(dict.fromkeys(one.label for one in evaluation.faults if begin <= one.time_ns < until_ns)),
            verdict=verdict.verdict,
            reason=verdict.reason,
            bins_from_mm=bins.from_mm,
            error_bins_um=bins.means((part.r - part.y) * 1e6),
            residual_bins_um=bins.means(workpiece * 1e6),
            current_bins_A=bins.means(part.current),
            guide_change_um=self._guide_change(part, stroke, bins),
        )

    def _verdict(self, stroke: Stroke) -> Verdict:
        evaluation, record = self.evaluation, self.evaluation.record
        times = (record.time[stroke.start] - _AROUND, record.time[stroke.stop - 1] + _AROUND)
        part = record.part(slice(*np.searchsorted(record.time, times).tolist()))
        return judged_run(part, self.reference, evaluation.parameters, evaluation.map, evaluation.stalls)

    def _bandwidth(self, part: StrokeRecord, coils: NDArray[np.float64]) -> float | None:
        """Of the amplifier in Hz, where no sample of the stroke is missing and its current steps show it."""
        steps = np.diff(part.time)
        if not np.isfinite(coils).all() or steps.max() > 1.5 * steps.min():
            return None
        period_ns = round(float(np.median(steps)) * 1e9)
        recording = Recording(period_ns, part.x, part.y, coils, part.current, part.time.size)
        path = current_path(recording, recorded_drive(self.evaluation.parameters.get("driver", {})))
        return path.rate / (2.0 * math.pi) if path.rate_found else None

    def _guide_change(self, part: StrokeRecord, stroke: Stroke, bins: Bins) -> list[float | None] | None:
        evaluation = self.evaluation
        if evaluation.guide is None or evaluation.map is None:
            return None
        change = evaluation.guide[stroke.samples] - evaluation.map.deviations(part.x)
        # The sensor's zero is arbitrary.
        return bins.means((change - np.nanmean(change)) * 1e6) if np.isfinite(change).any() else None


def recorded_facts(bag: Path, checksum: str, evaluation: BagEvaluation) -> Recorded:
    """The facts of a bag with this checksum, ``evaluation`` of the same bag; BagError when the bag is damaged."""
    attachments, reports, parameters = read_attachments(bag), evaluation.reports, evaluation.parameters
    origin = read_metadata(bag).get(ORIGIN_METADATA, {})
    facts = {
        name.removeprefix(_STAGE): value
        for name, value in parameters.get("driver", {}).items()
        if name.startswith(_STAGE)
    }
    own = {node: parameters[node] for node in _IN_THE_LOOP if node in parameters}
    survey = attachments.get(MAP_ATTACHMENT)
    return Recorded(
        checksum=checksum,
        bag=recorded_name(bag),
        stage=stored_name(str(facts.get("name") or "unknown")),
        identity=_identity(facts),
        parameters_checksum=checksum_of([json.dumps(own, sort_keys=True).encode()]) if own else None,
        map_checksum=None if survey is None else checksum_of([survey]),
        software_version=origin.get("version"),
        software_revision=origin.get("revision"),
        # The driver reports on the machine, the others on their computer.
        host=next((one.hardware_id for node in ("logger", "controller") for one in reports.get(node, ())), None),
    )


def recorded_name(bag: Path) -> str:
    """The name under which a bag was recorded, whatever its folder is called now."""
    return split_number(found_files(bag)[0][0])[0]


def _integral(time: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    return float((0.5 * (values[1:] + values[:-1]) * np.diff(time)).sum())


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _identity(facts: Mapping[str, Any]) -> str | None:
    try:
        return from_mapping(StageParameters, facts).identity if facts else None
    except ParameterError:
        # Recorded by a version with other facts.
        return None
