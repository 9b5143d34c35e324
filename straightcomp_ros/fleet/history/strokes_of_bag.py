"""The rows of a bag: figures of each of its strokes, by the code of `straightcomp evaluate`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from scipy.integrate import trapezoid

from straightcomp_ros.analysis.current_path import Recording, current_path
from straightcomp_ros.analysis.error_detail import stick_slips
from straightcomp_ros.analysis.evaluation import FOR_EVER, BagEvaluation, percentile_us, samples_taken
from straightcomp_ros.analysis.judged_motion import recorded_drive
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import force_balance, residual_of_stroke, standstill_figures, stroke_figures
from straightcomp_ros.analysis.record import Array, RecordedReference, Stroke, StrokeRecord
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.analysis.straightness_statement import statements
from straightcomp_ros.bags import MAP_ATTACHMENT
from straightcomp_ros.bags.folder import found_files, split_number
from straightcomp_ros.bags.information import ORIGIN_METADATA
from straightcomp_ros.bags.mcap_input import McapInput
from straightcomp_ros.bags.reader import read_attachments, read_metadata
from straightcomp_ros.fleet.history.rows import BIN_MM, StrokeRow, checksum_of, stored_name
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping, under
from straightcomp_ros.stage.description import StageParameters

_IN_THE_LOOP = ("driver", "feedforward", "controller")
"""Nodes whose parameters have an effect on a stroke. The logger's name each bag's folder."""
_WIDTH = 1e-3 * BIN_MM
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_SIMULATED_NS = 10**18
"""Stamps before September 2001, long before this package, are simulated time."""
_AROUND = 0.05
"""Time in s before and after a stroke that its verdict sees: there its motion is recognised as in the whole run."""


def binned(x: Array, columns: Mapping[str, Array | None]) -> dict[str, Any]:
    """By name the mean of each column (n,) in each bin over ``x`` (n,) in m, without values that are NaN; None for a
    bin without a value, and for no column. ``bins_from_mm`` is where the first bin begins.

    The bins are those of which a stroke covers at least half: a stroke that begins a count before an edge would
    otherwise have a bin of some samples at rest.
    """
    first = math.ceil(float(x.min()) / _WIDTH - 0.5)
    count = max(math.floor(float(x.max()) / _WIDTH + 0.5) - first, 0)
    places = np.floor(x / _WIDTH).astype(np.int64) - first
    covered = (places >= 0) & (places < count)

    def means(values: Array) -> list[float | None]:
        inside = covered & np.isfinite(values)
        samples = np.bincount(places[inside], minlength=count)
        sums = np.bincount(places[inside], values[inside], minlength=count)
        return [total / n if n else None for total, n in zip(sums.tolist(), samples.tolist(), strict=True)]

    found = {name: None if values is None else means(values) for name, values in columns.items()}
    return {"bins_from_mm": first * BIN_MM, **found}


def date_of_zero(bag: Path, begin_ns: int) -> timedelta:
    """What to add to the stamps of ``bag``, the first of which is ``begin_ns``: simulated time has no date, so that a
    simulated run counts as begun when its bag was made. Zero for stamps that have a date."""
    files, _ = found_files(bag)
    if begin_ns >= _SIMULATED_NS or files[0].suffix != ".mcap":
        return timedelta(0)
    with McapInput(files[0]) as opened:
        attached = map(opened.attachment, opened.records(Opcode.ATTACHMENT))
        # A time of creation that is not known is 0.
        made = [one.create_time or one.log_time for one in attached]
    return timedelta(microseconds=(min(made) - begin_ns) // 1000 if made else 0)


def rows_of(evaluation: BagEvaluation, facts: Mapping[str, Any], zero: timedelta = timedelta(0)) -> list[StrokeRow]:
    """The rows of a run, in the order of its strokes; ``facts`` are the columns that all have in common, ``zero`` is
    the date of stamp 0 since the epoch in simulated time; a clock that was set in the run has both kinds of stamps.

    Raises:
        MetricsError: the stage does not move, or a number within the motion is not finite.
    """
    record = evaluation.record
    strokes = record.motion.strokes
    record.check_finite(record.columns(), record.motion.window)
    stamps = evaluation.record_stamps.tolist()
    times = [(stamps[one.start], stamps[one.stop - 1]) for one in strokes]
    until = [*(begin for begin, _ in times[1:]), FOR_EVER]
    uncertainties: dict[str, dict[str, Any]] = {}
    for stated in statements(evaluation):
        name = f"{stated.when}_{stated.line}_U_um"
        uncertainties.setdefault(stated.direction, {})[name] = _known(stated.expanded_uncertainty * 1e6)
    after = standstill_figures(record, record.reference)
    rows: list[StrokeRow] = []
    for stroke, (begin, end), until_ns, rest in zip(strokes, times, until, after, strict=True):
        columns = _columns(evaluation, stroke, (begin, end), until_ns) | uncertainties.get(stroke.direction, {})
        columns |= {name: _known(value) for name, value in rest.to_display().items()}
        start = _EPOCH + zero * (begin < _SIMULATED_NS) + timedelta(microseconds=begin // 1000)
        rows.append(StrokeRow(**facts, **columns, stroke=len(rows) + 1, start=start))
    return rows


def _columns(evaluation: BagEvaluation, stroke: Stroke, times: tuple[int, int], until_ns: int) -> dict[str, Any]:
    """The columns of a stroke whose first and last sample have the stamps ``times``; faults until ``until_ns`` are its
    own."""
    record, reference, (begin, end) = evaluation.record, evaluation.record.reference, times
    part, coils = record.part(stroke.samples), evaluation.coil_current[stroke.samples]
    x, y, guide = part.best_known(evaluation.map or reference)
    workpiece = residual_of_stroke(part.time, x, guide + y)
    figures = stroke_figures(part, reference, stroke.direction, evaluation.map).to_display()
    del figures["start_s"]
    first, last = np.searchsorted(evaluation.stamps, (begin, end + 1)).tolist()
    stamps = evaluation.stamps[first:last]
    taken = samples_taken(stamps)
    latency = evaluation.latency[(evaluation.latency_stamps >= begin) & (evaluation.latency_stamps <= end)]
    verdict = evaluation.partial(begin, until_ns) or _verdict(evaluation, reference, stroke)
    balance = force_balance(part.time, part.y, coils)
    off = ~evaluation.amplifier_on[first:last]
    bins = {
        "error_bins_um": (part.r - part.y) * 1e6,
        "residual_bins_um": workpiece * 1e6,
        "current_bins_A": part.current,
        "guide_change_um": _guide_change_um(evaluation, part, stroke),
    }
    return dict(
        law=part.law,
        **figures,
        control_activity_A=float(np.abs(np.diff(part.current)).sum()),
        coil_work_A2s=float(trapezoid(part.current**2, part.time)),
        friction_A=_known(balance.friction),
        stiffness_A_per_m=_known(balance.stiffness),
        amplifier_bandwidth_Hz=_bandwidth(evaluation, part, coils),
        latency_p50_us=_known(percentile_us(latency, 50)),
        latency_p99_us=_known(percentile_us(latency, 99)),
        expected_samples=taken,
        lost_samples=taken - stamps.size,
        unanswered_samples=stamps.size - part.time.size,
        saturated_samples=int(np.count_nonzero(evaluation.at_current_limit[stroke.samples])),
        amplifier_off_samples=int(np.count_nonzero(off)),
        stick_slip_events=len(stick_slips(part.time, part.x, part.y, part.r, evaluation.count)),
        faults=list(dict.fromkeys(one.label for one in evaluation.faults if begin <= one.time_ns < until_ns)),
        **verdict._asdict(),
        **binned(part.x, bins),
    )


def _verdict(evaluation: BagEvaluation, reference: RecordedReference, stroke: Stroke) -> Verdict:
    time = evaluation.record.time
    start, stop = np.searchsorted(time, (time[stroke.start] - _AROUND, time[stroke.stop - 1] + _AROUND)).tolist()
    part = evaluation.record.part(slice(start, stop))
    readings = None if evaluation.readings is None else evaluation.readings[start:stop]
    known = evaluation.parameters, evaluation.map, evaluation.stalls
    return verdict_of(judged_motion(part, reference, *known, sensor=readings))


def _bandwidth(evaluation: BagEvaluation, part: StrokeRecord, coils: Array) -> float | None:
    """Of the amplifier in Hz, where no sample of the stroke is missing and its current steps show it."""
    steps = np.diff(part.time)
    if not np.isfinite(coils).all() or steps.max() > 1.5 * steps.min():
        return None
    period_ns = round(float(np.median(steps)) * 1e9)
    recording = Recording(period_ns, part.x, part.y, coils, part.current, part.time.size)
    path = current_path(recording, recorded_drive(evaluation.parameters.get("driver", {})))
    return path.rate / (2.0 * math.pi) if path.rate_found else None


def _guide_change_um(evaluation: BagEvaluation, part: StrokeRecord, stroke: Stroke) -> Array | None:
    """(n,); None where no sensor saw the guide, or the map is not known."""
    if evaluation.guide is None or evaluation.map is None:
        return None
    change = evaluation.guide[stroke.samples] - part.guide_by(evaluation.map)
    # The sensor's zero is arbitrary.
    return (change - np.nanmean(change)) * 1e6 if np.isfinite(change).any() else None


def recorded_facts(bag: Path, checksum: str, evaluation: BagEvaluation) -> tuple[str, dict[str, Any]]:
    """What a bag with this checksum says apart from its samples: the name of its stage, and columns of its rows;
    ``evaluation`` of the same bag. BagError when the bag is damaged."""
    attachments, reports, parameters = read_attachments(bag), evaluation.reports, evaluation.parameters
    origin = read_metadata(bag).get(ORIGIN_METADATA, {})
    stage = under("stage.", parameters.get("driver", {}))
    identity = None
    # One that was recorded by a version with other facts has no identity.
    with suppress(ParameterError):
        identity = from_mapping(StageParameters, stage).identity if stage else None
    own = {node: parameters[node] for node in _IN_THE_LOOP if node in parameters}
    survey = attachments.get(MAP_ATTACHMENT)
    return stored_name(str(stage.get("name") or "unknown")), {
        "checksum": checksum,
        # Whatever its folder is called now.
        "bag": split_number(found_files(bag)[0][0])[0],
        "identity": identity,
        "parameters_checksum": checksum_of([json.dumps(own, sort_keys=True).encode()]) if own else None,
        "map_checksum": None if survey is None else checksum_of([survey]),
        "software_version": origin.get("version"),
        "software_revision": origin.get("revision"),
        # The driver reports on the machine, the others on their computer.
        "host": next((one.hardware_id for node in ("logger", "controller") for one in reports.get(node, ())), None),
    }


def _known(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value
