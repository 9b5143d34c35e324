"""Step `acceptance`: a stroke of the stage under the designed law, and limits for all later ones.

On request the controller first learns from some strokes what correction of its reference makes them better, and keeps
it: gains of the step. The stroke that is judged comes after.

The stroke tells how well the platform follows the map. Whether the map is that of the guide, only a check survey tells.
"""

import dataclasses
import shutil
from dataclasses import dataclass
from typing import Any

import yaml

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.judgement import STARVED, Verdict
from straightcomp_ros.analysis.metrics import Metrics, evaluate
from straightcomp_ros.analysis.record import StrokeRecord
from straightcomp_ros.analysis.run_verdict import judged_bag
from straightcomp_ros.parameters.node_parameters import Values, by_node
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.straightness.guide_map import StraightnessMap, load_map, survey_check
from straightcomp_ros.straightness.survey import SurveyError
from straightcomp_ros.tuning.commissioning import LeftTravel
from straightcomp_ros.tuning.commissioning.checks import stroke_checks
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work
from straightcomp_ros.tuning.commissioning.step_files import LEARNED, LIMITS, STROKE
from straightcomp_ros.tuning.commissioning.timing_budget import timing_budget

_ALLOWANCE = 1.5
"""Of a later stroke over this one: a peak-to-peak moves from stroke to stroke."""
_REPEATS = 2
"""Cycles in place of those that the host disturbed. Where it disturbs three in a row, no run would be in order."""
_LIMITED = ("encoder_pp_um", "encoder_rms_um", "control_rms_step_A")


def acceptance(work: Work) -> Outcome:
    """Make one cycle, after those for learning, judge it, and write `limits.yaml`.

    A cycle that the host disturbed tells nothing of the machine: another one is made.
    """
    learning = _learning(work)
    # The certificate names all bags: one of strokes that no longer count must not be among them.
    shutil.rmtree(work.folder / "bags" / "learning", ignore_errors=True)
    values = {**work.values, "controller": {**work.values["controller"], **learning}}
    straightness = load_map(work.stage.guide)
    disturbed: list[str] = []
    try:
        if learning:
            (work.folder / LEARNED).unlink(missing_ok=True)
            work.machine.stroke(values, work.folder / "bags" / "learning", work.travel, work.learning_strokes)
        stroke = _stroke(work, values, straightness)
        while stroke.disturbance and len(disturbed) < _REPEATS:
            disturbed.append(stroke.disturbance)
            stroke = _stroke(work, values, straightness)
    except LeftTravel as error:
        return Outcome(False, str(error), {"disturbed_strokes": disturbed})
    figures = {**stroke.figures, "disturbed_strokes": disturbed}
    again = f" ({len(disturbed)} before it, disturbed by the host: {disturbed[0]})" if disturbed else ""
    if not stroke.verdict.in_order:
        return Outcome(False, f"the stroke is not in order: {stroke.verdict}{again}", figures)
    # Only here: matplotlib takes longer to import than the stroke to evaluate.
    from straightcomp_ros.analysis.pictures import plot_run

    title = f"Acceptance of stage '{work.stage.name}'"
    plot_run(stroke.record, straightness, stroke.metrics, work.folder / STROKE, title)
    checked, told = _checked(work, straightness)
    figures |= checked
    if checked and not checked["survey_agrees"]:
        return Outcome(False, told, figures)
    limits = {name: float(f"{_ALLOWANCE * figures[name]:.3g}") for name in _LIMITED}
    write_whole(work.folder / LIMITS, yaml.safe_dump(limits, sort_keys=False))
    learned = f" after {work.learning_strokes} strokes of learning" if learning else ""
    found = f"{figures['encoder_pp_um']:.2f} µm p-p, {figures['encoder_rms_um']:.3f} µm RMS by the encoder{learned}"
    return Outcome(True, f"{found}{again}; {told}", {**figures, "limits": limits}, gains=learning)


@dataclass(frozen=True, eq=False)
class _Stroke:
    """A cycle, and what it showed.

    Attributes:
        disturbance: what the host did to it, in words; empty if it served it well enough.
    """

    record: StrokeRecord
    metrics: Metrics
    verdict: Verdict
    figures: dict[str, Any]
    disturbance: str


def _stroke(work: Work, values: Values, straightness: StraightnessMap) -> _Stroke:
    """Make one cycle and evaluate it; raises LeftTravel."""
    bag = work.folder / "bags" / "acceptance"
    work.machine.stroke(values, bag, work.travel)
    run = evaluate_bag(bag)
    record, metrics = run.record, evaluate(run.record, straightness)
    # A real machine does not know the truth, so that a simulated one must not be judged by it.
    known = dataclasses.replace(record, true_x=None, true_y=None, guide=None)
    verdict = judged_bag(run, known, straightness, by_node(values), straightness)
    figures = {
        **metrics.to_display(),
        **verdict._asdict(),
        "lost_samples": run.lost_samples,
        "lost_commands": run.lost_commands,
    }
    disturbance = str(verdict) if verdict.verdict == STARVED else ""
    if verdict.in_order:
        figures["timing"] = timing_budget(work.described(), run.latency, work.travel)
        checks = stroke_checks(figures, work.stage.encoder.y_resolution)
        disturbance = "; ".join(str(one) for one in checks if not one.passed)
    return _Stroke(record, metrics, verdict, figures, disturbance)


def _learning(work: Work) -> dict[str, Any]:
    """Parameters of the controller with which it learns; none if it shall not."""
    if not work.learning_strokes:
        return {}
    # From another folder too, the nodes must find it.
    return {"learning.learn": True, "learning.file": str((work.folder / LEARNED).resolve())}


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
        "survey_check_points": found.points,
        "survey_check_runs": found.runs,
        "survey_checked_from_m": found.span[0],
        "survey_checked_to_m": found.span[1],
    }
    where = f"at {found.points} places from {found.span[0] * 1e3:.6g} to {found.span[1] * 1e3:.6g} mm"
    differs = f"by {found.difference * 1e6:.3g} µm RMS (allowed: {found.allowed * 1e6:.3g} µm) {where}, beside a line"
    if found.agrees:
        return figures, f"the survey agrees with the check: they differ {differs}"
    cause = (
        "the check has the opposite sign; look at the sign of the survey"
        if found.opposite
        else "look whether the survey is of this guide, its unit and its zero of x, and at the check"
    )
    return figures, (
        f"the survey is not that of the guide: they differ {differs}, where the guide itself has "
        f"{found.guide * 1e6:.3g} µm; {cause}"
    )
