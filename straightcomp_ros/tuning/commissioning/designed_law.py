"""Step `design`: gains of `smc_observer` for the machine as identified and what of it is still open."""

from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work
from straightcomp_ros.tuning.design.automatic_design import design_gains
from straightcomp_ros.tuning.design.feasible_gains import DesignError

LAW = "smc_observer"


def design(work: Work) -> Outcome:
    """Search the gains; nothing moves."""
    scenario = make_scenario(work.described(), [LAW])
    try:
        found = design_gains(
            scenario,
            LAW,
            evaluations=work.evaluations,
            machines=work.machines,
            progress=lambda part, fraction: work.progress(fraction if part == "search" else 0.0),
        )
    except DesignError as error:
        return Outcome(False, str(error))
    figures = {
        "predicted_pp_um": found.figures.pp.median * 1e6,
        "predicted_rms_um": found.figures.rms.median * 1e6,
        "predicted_step_mA": found.figures.work.median * 1e3,
        "uncertain_machines": found.verification.summary.to_display(),
        "limits": {state: one._asdict() for state, one in found.limits.items()},
        "budget": [{"cause": one.cause, "pp_um": one.pp * 1e6, "rms_um": one.rms * 1e6} for one in found.budget],
    }
    if not found.verification.holds:
        return Outcome(
            False,
            f"the designed law is not in order on all machines that are left: {found.verification.summary.verdict}",
            figures,
        )
    return Outcome(
        True,
        f"{found.figures.pp.median * 1e6:.3f} µm p-p predicted, at {found.figures.work.median * 1e3:.2f} mA from "
        "sample to sample",
        figures,
        gains={"control.law": LAW, **found.values},
    )
