"""Step `acceptance`: a stroke of the stage under the designed law, and limits for all later ones.

On request the controller first learns from some strokes what correction of its reference makes them better, and keeps
it: gains of the step. The stroke that is judged comes after.

The stroke shows how well the platform follows the map. Whether the map is that of the guide, only a check survey shows.
What late commands cost is found in simulation: the stroke again with the latencies that were measured, and with stalls.
"""

import dataclasses
import itertools
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from straightcomp_ros.analysis.evaluation import BagEvaluation, evaluate_bag
from straightcomp_ros.analysis.figure_words import with_digits
from straightcomp_ros.analysis.judgement import STARVED, Verdict
from straightcomp_ros.analysis.metrics import Metrics, evaluate
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.run_verdict import judged_motion, verdict_of
from straightcomp_ros.analysis.straightness_statement import statements
from straightcomp_ros.model.friction import BLOCKS
from straightcomp_ros.offline.starts import run_stroke, values_of_starts, with_values
from straightcomp_ros.parameters.node_parameters import Values, by_node, node_parameters
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map
from straightcomp_ros.straightness.survey_header import SurveyError
from straightcomp_ros.tuning.commissioning import LEARNED, LIMITS, STROKE, LeftTravel
from straightcomp_ros.tuning.commissioning.machine import Outcome, Work
from straightcomp_ros.tuning.commissioning.open_loop import latency_percentiles
from straightcomp_ros.tuning.survey.survey_check import survey_check

_ALLOWANCE = 1.5
"""Of a later stroke over this one: a peak-to-peak moves from stroke to stroke."""
_REPEATS = 2
"""Cycles in place of those that the host disturbed. Where it disturbs three in a row, no run would be in order."""
_LIMITED = ("encoder_pp_um", "encoder_rms_um", "control_rms_step_A")
_FEW = 1.0 / 200.0
"""Of the samples of a stroke, those that may be without a command: the law then leaves 0.16 µm in place of 0.14 µm."""
_LAST_BITS = 1e-9
"""Relative difference from a limit that is rounding."""
_EXPLAINED = 1.1
"""Of an error over the predicted one, what facts may make that are known within 5 %; blocks made 1.26 to 2.8."""
_STALLS_MS = (1, 2, 5, 10, 20, 50, 100)
_APART_S = 0.7
"""Time from stall to stall, in which the platform comes back; no multiple of what the guide repeats."""
_SETTLED_S = 0.5


def acceptance(work: Work) -> Outcome:
    """Make one cycle, after those for learning, judge it, and write `limits.yaml`.

    A cycle that the host disturbed says nothing of the machine: another one is made.
    """
    bags, learning = work.folder / "bags", {}
    if work.learning_strokes:
        # From another folder too, the nodes must find it.
        learning = {"learning.learn": True, "learning.file": str((work.folder / LEARNED).resolve())}
    # The certificate names all bags: one of strokes that no longer count must not be among them.
    shutil.rmtree(bags / "learning", ignore_errors=True)
    values, straightness = with_values(work.values, "controller", learning), load_map(work.stage.guide)
    disturbed: list[str] = []
    try:
        if learning:
            (work.folder / LEARNED).unlink(missing_ok=True)
            work.machine.stroke(values, bags / "learning", work.travel, work.learning_strokes)
        stroke = _stroke(work, values, straightness)
        while stroke.disturbance and len(disturbed) < _REPEATS:
            disturbed.append(stroke.disturbance)
            stroke = _stroke(work, values, straightness)
    except LeftTravel as error:
        return Outcome(False, str(error), {"disturbed_strokes": disturbed})
    figures = {**stroke.figures, "disturbed_strokes": disturbed, "learning_strokes": work.learning_strokes}
    again = f" ({len(disturbed)} before it, disturbed by the host: {disturbed[0]})" if disturbed else ""
    learned = f" after {work.learning_strokes} strokes of learning" if learning else ""
    pp, rms = with_digits(figures["encoder_pp_um"], 2), with_digits(figures["encoder_rms_um"], 3)
    found = f"{pp} µm p-p, {rms} µm RMS by the encoder{learned}"
    if not learning and not stroke.disturbance and (before := _presliding(work, stroke)):
        gives_way = "its friction gives way as blocks do, not bristles, for which the law is designed once more"
        return Outcome(True, f"{found}{again}; {gives_way}", figures, before=before)
    if not stroke.verdict.in_order:
        return Outcome(False, f"the stroke is not in order: {stroke.verdict}{again}", figures)
    # Only here: matplotlib takes longer to import than the stroke to evaluate.
    from straightcomp_ros.analysis.pictures import plot_run

    title = f"Acceptance of stage '{work.stage.name}'"
    plot_run(stroke.run.record, straightness, stroke.metrics, work.folder / STROKE, title)
    checked, survey = _checked(work, straightness)
    figures |= checked
    if checked and not checked["survey_agrees"]:
        return Outcome(False, survey, figures)
    limits = {name: float(f"{_ALLOWANCE * figures[name]:.3g}") for name in _LIMITED}
    write_whole(work.folder / LIMITS, yaml.safe_dump(limits, sort_keys=False))
    return Outcome(True, f"{found}{again}; {survey}", {**figures, "limits": limits}, gains=learning)


def _presliding(work: Work, stroke: "_Stroke") -> dict[str, Any]:
    """The fact that friction gives way as blocks do, where it is described with bristles, the machine as described
    leaves less than the ``stroke`` did from all starts, and blocks explain more than half of the difference.

    A platform that is known in sliding may resist in another way before it slides. A law that was designed for bristles
    is too slow for blocks, which push back for longer after a reversal.
    """
    stage = work.stage
    if stage.friction.model == BLOCKS or not stage.friction.coulomb > 0.0:
        return {}
    blocks = {"friction.model": BLOCKS}
    late = _late(stroke.run.latency, round(stage.drive.delay * stage.period_ns))
    described, measured = _predicted(work.described(), late), float(stroke.figures["encoder_rms_um"])
    if not measured > _EXPLAINED * max(described):
        return {}
    bristles = float(np.median(described))
    slipping = float(np.median(_predicted(with_values(work.described(), "stage", blocks), late)))
    # Too little of it, and too much, is another cause's.
    least, most = math.sqrt(bristles * measured), measured**2 / bristles
    return blocks if least < slipping < most else {}


def _predicted(values: Values, late: NDArray[np.int64]) -> list[float]:
    """RMS error by the encoder in µm from each start; infinite where the platform is lost."""
    found = []
    for one in values_of_starts(values):
        try:
            record, straightness = run_stroke(one, late)
            found.append(float(evaluate(record, straightness).to_display()["encoder_rms_um"]))
        except ValueError:
            found.append(math.inf)
    return found


class _Stroke(NamedTuple):
    """A cycle, what it showed, and how the host disturbed it, in words; empty if it did not."""

    run: BagEvaluation
    metrics: Metrics
    verdict: Verdict
    figures: dict[str, Any]
    disturbance: str


def _stroke(work: Work, values: Values, straightness: StraightnessMap) -> _Stroke:
    """Make one cycle and evaluate it; raises LeftTravel."""
    bag = work.folder / "bags" / "acceptance"
    work.machine.stroke(values, bag, work.travel)
    run = evaluate_bag(bag)
    metrics = evaluate(run.record, straightness)
    # A real machine does not know the truth, so that a simulated one must not be judged by it.
    known = dataclasses.replace(run.record, true_x=None, true_y=None, guide=None)
    verdict = run.partial() or verdict_of(judged_motion(known, straightness, by_node(values), straightness, run.stalls))
    figures = {**metrics.to_display(), **verdict._asdict()}
    figures["straightness"] = [one.to_display() for one in statements(run)]
    figures |= {"lost_samples": run.lost_samples, "lost_commands": run.lost_commands}
    disturbance = str(verdict) if verdict.verdict == STARVED else ""
    if verdict.in_order:
        figures["timing"] = timing_budget(work.described(), run.latency, work.travel)
        checks = stroke_checks(figures, work.stage.encoder.y_resolution)
        disturbance = "; ".join(str(one) for one in checks if not one.passed)
    return _Stroke(run, metrics, verdict, figures, disturbance)


def _checked(work: Work, straightness: StraightnessMap) -> tuple[dict[str, Any], str]:
    """Figures of the check survey, none without one, and what it says."""
    if work.check_survey is None:
        return {}, "the survey of the guide was not verified (--check-survey)"
    try:
        found = survey_check(straightness, work.check_survey, work.stage.uncertainty.map_noise)
    except SurveyError as error:
        return {"survey_agrees": False}, str(error)
    figures = {
        "survey_agrees": found.agrees,
        "survey_difference_um": found.difference * 1e6,
        "survey_difference_allowed_um": found.allowed * 1e6,
        "survey_check": work.check_survey.source,
        "survey_check_sha256": work.check_survey.digest,
        "survey_check_points": found.points,
        "survey_check_runs": found.runs,
        "survey_checked_from_m": found.span[0],
        "survey_checked_to_m": found.span[1],
    }
    where = f"at {found.points} places from {found.span[0] * 1e3:.6g} to {found.span[1] * 1e3:.6g} mm"
    differ = (
        f"they differ by {found.difference * 1e6:.3g} µm RMS (allowed: {found.allowed * 1e6:.3g} µm) {where}, apart "
        "from a line"
    )
    if found.agrees:
        return figures, f"the survey agrees with the check: {differ}"
    cause = "look whether the survey is of this guide, its unit and its zero of x, and at the check"
    if found.opposite:
        cause = "the check has the opposite sign; look at the sign of the survey"
    own = f"where the guide itself has {found.guide * 1e6:.3g} µm"
    return figures, f"the survey is not that of the guide: {differ}, {own}; {cause}"


class Check(NamedTuple):
    """A figure of a step with what is allowed, and whether it is."""

    step: str
    name: str
    value: float
    allowed: str
    passed: bool

    def __str__(self) -> str:
        value = "infinite, since the platform is lost" if math.isinf(self.value) else f"{self.value:.4g}"
        return f"{self.name} {value} (allowed: {self.allowed})"


def limited(step: str, name: str, value: float, relation: str, limit: float) -> Check:
    """A figure that must be ``>=`` or ``<=`` its limit, by its ``relation``."""
    within = value >= limit if relation == ">=" else value <= limit
    passed = within or math.isclose(value, limit, rel_tol=_LAST_BITS)
    return Check(step, name, value, f"{relation} {limit:.4g}", passed)


def stroke_checks(accepted: Mapping[str, Any], count: float) -> Iterator[Check]:
    """Whether the host disturbed the stroke of `acceptance`, from its figures; ``count`` of the encoder in m."""
    yield limited("acceptance", "lost samples of the stroke", accepted["lost_samples"], "<=", 0.0)
    few = float(math.ceil(_FEW * accepted["samples"]))
    yield limited("acceptance", "samples of the stroke without a command", accepted["lost_commands"], "<=", few)
    timing = accepted["timing"]
    if "as_measured_costs_um" in timing:
        # A record that was read again has no infinity.
        cost = math.inf if timing["as_measured_costs_um"] is None else timing["as_measured_costs_um"]
        # They may double the error, as the stalls of a run that is in order may, and no encoder sees less than a count.
        allowed = max(float(timing["in_time_pp_um"]), count * 1e6)
        yield limited("acceptance", "what its latencies cost [µm p-p]", cost, "<=", allowed)


def stalled(count: int, period_ns: int, due_ns: int, stall_ms: float, starts: range) -> NDArray[np.int64]:
    """Delays (count,) in ns of commands that are due after ``due_ns``, on a host that stalls at the samples ``starts``:
    what it had to answer meanwhile comes at the end of the stall."""
    length = round(stall_ms * 1e6 / period_ns)
    delays = np.full(count, due_ns, dtype=np.int64)
    for start in starts:
        last = min(count, start + length)
        delays[start:last] = np.maximum(due_ns, np.arange(length, 0, -1)[: last - start] * period_ns)
    return delays


def _late(latency: NDArray[np.float64], due_ns: int) -> NDArray[np.int64]:
    """Delays in ns of the commands that came with ``latency`` (n,) in s."""
    return np.maximum(due_ns, np.round(latency[np.isfinite(latency)] * 1e9).astype(np.int64))


def timing_budget(values: Values, latency: NDArray[np.float64], travel: float) -> dict[str, Any]:
    """Figures of the timing of a machine as known; a cost or an error is infinite where the platform is lost.

    ``latency`` (n,) is the time in s from each sample until its command arrived, ``travel`` the largest error in m that
    counts as survived.
    """
    driver = node_parameters("driver", values)
    period_ns, due_ns = driver.stage.period_ns, round(driver.stage.drive.delay * driver.stage.period_ns)
    record, straightness = run_stroke(values)
    size, apart = record.time.size, round(_APART_S * 1e9 / period_ns)
    # A cycle may be shorter than the time to settle.
    first = min(round(_SETTLED_S * 1e9 / period_ns), size // 4)

    def peak_to_peak_um(stroke: StrokeRecord) -> float:
        pp = evaluate(stroke, straightness).true_pp
        assert pp is not None  # a simulation has truth
        return pp * 1e6

    def largest(stroke: StrokeRecord) -> float:
        error = stroke.true_error(straightness)
        assert error is not None
        return float(np.abs(error[first:]).max())

    def late(figure: Callable[[StrokeRecord], float], delays: NDArray[np.int64]) -> float:
        try:
            return figure(run_stroke(values, delays)[0])
        except ValueError:
            return math.inf

    in_time, percentiles = peak_to_peak_um(record), latency_percentiles(latency)
    found: dict[str, Any] = {"latency_us": percentiles, "due_us": due_ns * 1e-3, "in_time_pp_um": in_time}
    if percentiles:
        measured = _late(latency, due_ns)
        found["as_measured_costs_um"] = late(peak_to_peak_um, measured) - in_time
        p99 = np.full_like(measured, max(due_ns, round(percentiles["p99"] * 1e3)))
        found["p99_costs_um"] = late(peak_to_peak_um, p99) - in_time
    errors = {
        stall_ms: late(largest, stalled(size, period_ns, due_ns, stall_ms, range(first, size, apart)))
        for stall_ms in _STALLS_MS
    }
    limit_ms = driver.machine.command_timeout * 1e3
    survived = itertools.takewhile(lambda stall_ms: stall_ms < limit_ms and errors[stall_ms] <= travel, _STALLS_MS)
    found["stall_error_um"] = {f"{stall_ms} ms": error * 1e6 for stall_ms, error in errors.items()}
    found["amplifier_off_after_ms"] = limit_ms
    found["longest_stall_survived_ms"] = max(survived, default=0)
    return found
