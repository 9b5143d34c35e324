"""The assessment of a recorded run: figures by name, the strokes, gaps and intervals behind them, and their limits."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.analysis.error_detail import BANDS, error_spectrum, stick_slips
from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag, percentile_us
from straightcomp_ros.analysis.metrics import LINES, evaluate, standstill_figures, stroke_figures
from straightcomp_ros.analysis.record import Array, MetricsError, runs_of
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.analysis.straightness_statement import statements
from straightcomp_ros.bags import noting_warnings
from straightcomp_ros.parameters.declaration import ParameterError, instead
from straightcomp_ros.parameters.yaml_text import YamlError, load_yaml, number_or_nan


class Interval(NamedTuple):
    """A stretch of the run: times of its first and last sample in s, and how many samples it covers or lacks."""

    start: float
    end: float
    samples: int


class Assessment:
    """A recorded run with all its figures; ``sensor`` as in :func:`statements`.

    MetricsError if the stage does not move, or a number within the motion is not finite.
    """

    def __init__(self, bag: Path, evaluation: BagEvaluation, sensor: float | None = None) -> None:
        self.bag, self.evaluation = bag, evaluation
        self.warnings: Sequence[str] = ()  # the reader's about the bag
        self.record = record = evaluation.record
        self.partial = partial = evaluation.partial()
        try:
            moving = record.moving
        except MetricsError as found:
            raise (MetricsError(f"{partial}; while the law ran: {found}") if partial else found) from found
        reference = record.reference
        time = np.asarray((evaluation.stamps - evaluation.begin_ns) * 1e-9, dtype=np.float64)
        strokes = [(record.part(one.samples), one.direction) for one in record.motion.strokes]
        self.metrics = evaluate(record, reference, evaluation.map)
        self.strokes = [stroke_figures(one, reference, direction, evaluation.map) for one, direction in strokes]
        self.standstills = standstill_figures(record, reference)
        self.straightness = [one.to_display() for one in statements(evaluation, sensor)]
        # Of the compensation error as the encoder sees it, while the stage moves.
        self.spectrum = error_spectrum(moving.time, moving.r - moving.y)
        # Samples that the clock took and the bag lacks.
        periods = np.diff(time) / np.median(np.diff(time))
        paused = np.isin(evaluation.stamps[:-1], evaluation.pauses)
        gaps = np.flatnonzero((periods > 1.5) & ~paused).tolist()
        self.gaps = [Interval(float(time[at]), float(time[at + 1]), round(float(periods[at])) - 1) for at in gaps]
        # Where the command was at the law's current limit.
        self.saturated = _intervals(record.time, evaluation.at_current_limit)
        # Where the amplifier was off between the run's first motion and its last, as the encoder saw the stage move,
        # whether the law ran or not: a fault, or a stop.
        self.amplifier_off: list[Interval] = []
        if seen := evaluation.encoder.strokes:
            off, first, last = evaluation.encoder.off, time[seen[0].start], time[seen[-1].stop - 1]
            self.amplifier_off = [one for one in _intervals(time, off) if one.start <= last and one.end >= first]
        parts = [(one.time, one.x, one.y, one.r) for one, _ in strokes]
        self.stick_slips = [event for part in parts for event in stick_slips(*part, evaluation.count)]
        known = evaluation.parameters, evaluation.map, evaluation.stalls, evaluation.latency, evaluation.readings
        judged = judged_motion(record, reference, *known)
        self.uncompensated, self.verdict = judged.still, partial or verdict_of(judged)

    def figures(self) -> dict[str, Any]:
        """Numbers by name, the unit in each name; limits can be set for them. NaN or None: not recorded; infinite: a
        settling time without end."""
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
            for name in (f"{when}_{line}" for when in ("before", "after") for line in LINES):
                worst = max((getattr(stroke, name) for stroke in ours), default=None)
                figures[f"straightness_{name}_{way}_um"] = None if worst is None else worst * 1e6
        # A movement that does not settle takes longer than any limit.
        settling = np.nan_to_num([one.settling for one in self.standstills if one.settling is not None], nan=math.inf)
        figures["settling_median_s"] = float(np.median(settling)) if settling.size else math.nan
        figures["settling_max_s"] = float(np.max(settling)) if settling.size else math.nan
        for name in ("standstill_pp", "reversal_pp"):
            known = [value for one in self.standstills if (value := getattr(one, name)) is not None]
            figures[f"{name}_um"] = max(known) * 1e6 if known else None
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
        intervals = {"gap": self.gaps, "saturation": self.saturated, "amplifier_off": self.amplifier_off}
        return {
            "bag": str(self.bag),
            "law": self.record.law,
            **self.verdict._asdict(),
            **self.figures(),
            "strokes": [
                stroke.to_display() | after.to_display()
                for stroke, after in zip(self.strokes, self.standstills, strict=True)
            ],
            "straightness": self.straightness,
            **{f"{name}_intervals": [one._asdict() for one in found] for name, found in intervals.items()},
            "stick_slip": [asdict(event) for event in self.stick_slips],
            "warnings": list(self.warnings),
        }


def _intervals(time: Array, mask: NDArray[np.bool_]) -> list[Interval]:
    return [Interval(float(time[a]), float(time[b - 1]), b - a) for a, b in runs_of(mask).tolist()]


def assessed(bag: Path, remap: Mapping[str, str] | None = None, sensor: float | None = None) -> Assessment:
    """The assessment of the bag with the reader's warnings, each once, which are given nowhere else; arguments and
    errors as of :func:`evaluate_bag` and :class:`Assessment`."""
    with noting_warnings() as texts:
        found = Assessment(bag, evaluate_bag(bag, remap), sensor)
    found.warnings = texts
    return found


class LimitCheck(NamedTuple):
    """The smallest and the largest value that is allowed for a figure, and its value; None if it was not recorded."""

    name: str
    minimum: float
    maximum: float
    value: float | None

    @property
    def passed(self) -> bool:
        """Whether the value is within the limit; a figure that was not recorded fails."""
        return self.value is not None and self.minimum <= self.value <= self.maximum

    @property
    def allowed(self) -> str:
        """The limits in words."""
        bounds = ((">=", self.minimum), ("<=", self.maximum))
        return " and ".join(f"{sign} {value:g}" for sign, value in bounds if math.isfinite(value))

    def __str__(self) -> str:
        found = "was not recorded" if self.value is None else f"is {self.value:.6g}"
        return f"{self.name} {found}; allowed: {self.allowed}"


def checked_limits(path: str | Path, figures: Mapping[str, Any] | None = None) -> list[LimitCheck]:
    """A check of ``figures`` for each limit of a YAML file, in its order; the limits alone without them.

        true_pp_um: 0.5                    # at most
        lost_samples: {max: 0}
        received_samples: {min: 30000}
        latency_p99_us: {max: 400}

    Raises:
        ParameterError: the file cannot be read, is no mapping, names an unknown figure or sets no number.
    """
    where = f"limits {path}"
    try:
        tree = load_yaml(Path(path))
    except OSError as error:
        raise ParameterError(f"{where}: cannot be read: {error.strerror}") from error
    except YamlError as error:
        raise ParameterError(f"{where}: {error}") from error
    if not isinstance(tree, Mapping) or not tree:
        allowed = "lines 'FIGURE: MAXIMUM' or 'FIGURE: {min: …, max: …}'"
        raise ParameterError(f"{where}: sets no limit; allowed: {allowed}")
    return [_check(where, str(name), limit, figures) for name, limit in tree.items()]


def _check(where: str, name: str, limit: Any, figures: Mapping[str, Any] | None) -> LimitCheck:
    if figures is not None and name not in figures:
        raise ParameterError(f"{where}: figure '{name}' is unknown{instead(name, figures)}")
    given = limit if isinstance(limit, Mapping) else {"max": limit}
    bounds = {key: number_or_nan(one) for key, one in given.items()}
    if not bounds or set(bounds) - {"min", "max"} or not all(map(math.isfinite, bounds.values())):
        raise ParameterError(f"{where}: {name}: {limit!r}; allowed: a number, or {{min: number, max: number}}")
    minimum, maximum, value = bounds.get("min", -math.inf), bounds.get("max", math.inf), (figures or {}).get(name)
    if minimum > maximum:
        raise ParameterError(f"{where}: {name}: min {minimum:g} is above max {maximum:g}")
    return LimitCheck(name, minimum, maximum, None if value is None or math.isnan(value) else value)
