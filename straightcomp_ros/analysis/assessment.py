"""The assessment of a recorded run: figures by name, the strokes, gaps and intervals behind them, and their limits."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.error_detail import BANDS, Spectrum, StickSlip, error_spectrum, stick_slips
from straightcomp_ros.analysis.evaluation import BagEvaluation, percentile_us
from straightcomp_ros.analysis.interruption import PAUSE
from straightcomp_ros.analysis.judgement import Verdict
from straightcomp_ros.analysis.metrics import Metrics, MetricsError, StrokeFigures, evaluate, stroke_figures, true_error
from straightcomp_ros.analysis.record import Motion, RecordedReference, find_motion, runs_of
from straightcomp_ros.analysis.run_verdict import judged_bag, partial_run
from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml

_AT_LIMIT = 1.0 - 1e-9
"""Fraction of the current limit from which the command counts as limited."""


class Interval(NamedTuple):
    """A stretch of the run: times of its first and last sample in s, and how many samples it covers or lacks."""

    start: float
    end: float
    samples: int


@dataclass(frozen=True, eq=False)
class Assessment:
    """A run with all its figures.

    Attributes:
        bag: the bag's path.
        evaluation, motion, reference, metrics: the run, when it moved, its reference over x, its figures.
        strokes: figures of each stroke, in order.
        spectrum: of the compensation error as the encoder sees it, while the stage moves.
        gaps: samples that the clock took and the bag lacks.
        saturated: where the command was at the law's current limit.
        amplifier_off: where the amplifier was off between the run's first motion and its last: a fault, or a stop.
        stick_slips: events of all strokes.
        verdict: on the run.
        warnings: the reader's warnings about the bag.
    """

    bag: Path
    evaluation: BagEvaluation
    motion: Motion
    reference: RecordedReference
    metrics: Metrics
    strokes: list[StrokeFigures]
    spectrum: Spectrum
    gaps: list[Interval]
    saturated: list[Interval]
    amplifier_off: list[Interval]
    stick_slips: list[StickSlip]
    verdict: Verdict
    warnings: tuple[str, ...] = ()

    def figures(self) -> dict[str, Any]:
        """Numbers by name, the unit in each name; limits can be set for them. NaN or None: not recorded."""
        evaluation = self.evaluation
        counts = ("expected_samples", "received_samples", "lost_samples", "lost_references", "lost_commands")
        figures: dict[str, Any] = {
            **{name: getattr(evaluation, name) for name in counts},
            "gaps": len(self.gaps),
            "longest_gap_s": max((gap.end - gap.start for gap in self.gaps), default=0.0),
            **self.metrics.to_display(),
        }
        for way in ("forward", "backward"):
            ours = [stroke for stroke in self.strokes if stroke.direction == way]
            for name in ("before_least_squares", "before_end_points", "after_least_squares", "after_end_points"):
                worst = max((getattr(stroke, name) for stroke in ours), default=None)
                figures[f"straightness_{name}_{way}_um"] = None if worst is None else worst * 1e6
        for low, high in BANDS:
            figures[f"error_rms_{low:g}_{high:g}_Hz_um"] = self.spectrum.band_rms(low, high) * 1e6
        for name, values in (("latency", evaluation.latency), ("lateness", evaluation.lateness)):
            for label, percentile in (("p50", 50), ("p90", 90), ("p99", 99), ("max", 100)):
                figures[f"{name}_{label}_us"] = percentile_us(values, percentile)
        jitter = float(np.std(evaluation.latency)) * 1e6 if len(evaluation.latency) else math.nan
        return figures | {
            "latency_jitter_us": jitter,
            "stick_slip_events": len(self.stick_slips),
            "saturated_samples": sum(interval.samples for interval in self.saturated),
            "saturations": len(self.saturated),
            "amplifier_off_in_motion": len(self.amplifier_off),
        }

    def as_json(self) -> dict[str, Any]:
        """The figures, and all lists behind them."""
        return {
            "bag": str(self.bag),
            "law": self.evaluation.record.law,
            **self.verdict._asdict(),
            **self.figures(),
            "strokes": [stroke.to_display() for stroke in self.strokes],
            "spectrum_peaks": [
                {"frequency_Hz": frequency, "amplitude_density_um_per_sqrt_Hz": math.sqrt(density) * 1e6}
                for frequency, density in self.spectrum.peaks()
            ],
            "gap_intervals": [interval._asdict() for interval in self.gaps],
            "saturation_intervals": [interval._asdict() for interval in self.saturated],
            "amplifier_off_intervals": [interval._asdict() for interval in self.amplifier_off],
            "stick_slip": [asdict(event) for event in self.stick_slips],
            "warnings": list(self.warnings),
        }


def assess(bag: Path, evaluation: BagEvaluation, warnings: tuple[str, ...] = ()) -> Assessment:
    """Assess a recorded run; MetricsError if the stage does not move, or a number within the motion is not finite."""
    record = evaluation.record
    try:
        motion, reference = find_motion(record), RecordedReference(record)
    except MetricsError as found:
        partial = partial_run(evaluation)
        raise (MetricsError(f"{partial}; while the law ran: {found}") if partial else found) from found
    window = motion.window
    error = record.r - record.y
    time = (evaluation.stamps - evaluation.stamps[0]) * 1e-9
    strokes = evaluation.encoder.strokes if evaluation.encoder else ()
    # As the encoder saw the stage move, whether the law ran or not.
    first, last = (time[strokes[0].start], time[strokes[-1].stop - 1]) if strokes else (math.inf, -math.inf)
    off = _intervals(time, evaluation.encoder.off) if evaluation.encoder else []
    truth = true_error(record, reference)
    columns = np.array([record.time, record.x, record.y, record.r])
    return Assessment(
        bag=bag,
        evaluation=evaluation,
        motion=motion,
        reference=reference,
        metrics=evaluate(record, reference),
        strokes=[stroke_figures(record, reference, truth, stroke) for stroke in motion.strokes],
        spectrum=error_spectrum(record.time[window], error[window]),
        gaps=_gaps(time),
        saturated=_intervals(record.time, at_current_limit(evaluation)),
        amplifier_off=[interval for interval in off if interval.start <= last and interval.end >= first],
        stick_slips=[event for stroke in motion.strokes for event in stick_slips(*columns[:, stroke.samples])],
        verdict=judged_bag(evaluation, record, reference, evaluation.parameters, evaluation.map),
        warnings=warnings,
    )


def at_current_limit(evaluation: BagEvaluation) -> NDArray[np.bool_]:
    """The samples (n,) of the record with the command at the law's current limit; none where that was not recorded."""
    limit = evaluation.parameters.get("controller", {}).get("stage.actuator.current_limit", math.inf)
    return np.asarray(np.abs(evaluation.record.current) >= _AT_LIMIT * float(limit))


def displayed_error(assessment: Assessment) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Compensation error in m as the encoder sees it and, where it is known, the true one."""
    record = assessment.evaluation.record
    return record.r - record.y, true_error(record, assessment.reference)


def _gaps(time: NDArray[np.float64]) -> list[Interval]:
    pauses = np.diff(time) >= PAUSE
    steps = np.diff(time) / np.median(np.diff(time))
    gaps = np.flatnonzero((steps > 1.5) & ~pauses)
    return [Interval(float(time[at]), float(time[at + 1]), round(float(steps[at])) - 1) for at in gaps]


def _intervals(time: NDArray[np.float64], mask: NDArray[np.bool_]) -> list[Interval]:
    return [Interval(float(time[a]), float(time[b - 1]), b - a) for a, b in runs_of(mask).tolist()]


class LimitsError(ValueError):
    """A file of limits is refused; the message names the file, the figure and what is allowed."""


class Limit(NamedTuple):
    """Smallest and largest value that is allowed for a figure."""

    name: str
    minimum: float
    maximum: float


class LimitCheck(NamedTuple):
    """A limit, the figure's value, and whether it is within the limit. A figure that was not recorded fails."""

    limit: Limit
    value: float | None
    passed: bool

    def __str__(self) -> str:
        bounds = ((">=", self.limit.minimum), ("<=", self.limit.maximum))
        allowed = " and ".join(f"{sign} {value:g}" for sign, value in bounds if math.isfinite(value))
        found = "was not recorded" if self.value is None else f"is {self.value:.6g}"
        return f"{self.limit.name} {found}; allowed: {allowed}"


def read_limits(path: str | Path, known: Mapping[str, Any]) -> list[Limit]:
    """Limits of a YAML file, for figures among ``known``.

        true_pp_um: 0.5                    # at most
        lost_samples: {max: 0}
        received_samples: {min: 30000}
        latency_p99_us: {max: 400}

    Raises:
        LimitsError: the file cannot be read, is no mapping, names an unknown figure or sets no number.
    """
    where = f"limits {path}"
    try:
        tree = load_yaml(Path(path))
    except OSError as error:
        raise LimitsError(f"{where}: cannot be read: {error.strerror}") from error
    except YamlError as error:
        raise LimitsError(f"{where}: {error}") from error
    if not isinstance(tree, Mapping) or not tree:
        raise LimitsError(f"{where}: sets no limit; allowed: lines 'FIGURE: MAXIMUM' or 'FIGURE: {{min: …, max: …}}'")
    return [_limit(where, str(name), value, known) for name, value in tree.items()]


def judged(limits: list[Limit], figures: Mapping[str, Any]) -> list[LimitCheck]:
    """A check of each limit, in its order."""
    checks = []
    for limit in limits:
        value = figures[limit.name]
        known = value is not None and math.isfinite(value)
        checks.append(LimitCheck(limit, value if known else None, known and limit.minimum <= value <= limit.maximum))
    return checks


def _limit(where: str, name: str, value: Any, known: Mapping[str, Any]) -> Limit:
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        raise LimitsError(f"{where}: figure '{name}' is unknown; {hint}")
    given = value if isinstance(value, Mapping) else {"max": value}
    bounds = {key: _number(one) for key, one in given.items()}
    if not bounds or set(bounds) - {"min", "max"} or not all(map(math.isfinite, bounds.values())):
        raise LimitsError(f"{where}: {name}: {value!r}; allowed: a number, or {{min: number, max: number}}")
    limit = Limit(name, bounds.get("min", -math.inf), bounds.get("max", math.inf))
    if limit.minimum > limit.maximum:
        raise LimitsError(f"{where}: {name}: min {limit.minimum:g} is above max {limit.maximum:g}")
    return limit


def _number(value: Any) -> float:
    """NaN for what is no number. YAML 1.1 reads 1e-6 as a text."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan
