"""Step `acceptance`: a stroke of the stage under the designed law, and limits for all later ones."""

import yaml

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.analysis.run_verdict import judged_run
from straightcomp_ros.commissioning import LeftTravel
from straightcomp_ros.commissioning.outcome import Outcome, Work
from straightcomp_ros.configuration.node_parameters import by_node
from straightcomp_ros.settings.whole_file import write_whole
from straightcomp_ros.straightness.guide_map import load_map

_ALLOWANCE = 1.5
"""Of a later stroke over this one: a peak-to-peak moves from stroke to stroke."""
_LIMITED = ("encoder_pp_um", "encoder_rms_um", "control_rms_step_A")


def acceptance(work: Work) -> Outcome:
    """Make one cycle, judge it, and write `limits.yaml`."""
    bag = work.folder / "bags" / "acceptance"
    try:
        work.machine.stroke(work.values, bag, work.travel)
    except LeftTravel as error:
        return Outcome(False, str(error))
    run = evaluate_bag(bag)
    record, straightness = run.record, load_map(work.stage.guide)
    verdict = judged_run(record, straightness, by_node(work.values), straightness, run.stalls)
    figures = {**evaluate(record, straightness).to_display(), **verdict._asdict()}
    if not verdict.in_order:
        return Outcome(False, f"the stroke is not in order: {verdict}", figures)
    limits = {name: float(f"{_ALLOWANCE * figures[name]:.3g}") for name in _LIMITED}
    write_whole(work.folder / "limits.yaml", yaml.safe_dump(limits, sort_keys=False))
    return Outcome(
        True,
        f"{figures['encoder_pp_um']:.2f} µm p-p, {figures['encoder_rms_um']:.3f} µm RMS by the encoder",
        {**figures, "limits": limits},
    )
