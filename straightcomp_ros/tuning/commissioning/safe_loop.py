"""Step `safe_loop`: a law for the stated uncertainty, with which the loop is closed for the first time."""

from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.tuning.commissioning.outcome import Outcome, Work
from straightcomp_ros.tuning.design.feasible_gains import DesignError
from straightcomp_ros.tuning.design.safe_law import LAW, safe_law


def safe_loop(work: Work) -> Outcome:
    """Find the law; nothing moves yet."""
    try:
        found = safe_law(make_scenario(work.described(), [LAW]), progress=work.progress)
    except DesignError as error:
        return Outcome(False, str(error))
    return Outcome(
        True,
        f"'{LAW}' holds at all {found.corners} corners of the uncertainty; the slowest mode decays with "
        f"{found.decay:.3g} 1/s",
        {
            "decay_1_s": found.decay,
            "worst_corner": found.worst,
            "simulated_excursion_um": found.excursion * 1e6,
            "simulated_pp_um": found.pp * 1e6,
        },
        gains={"control.law": LAW, **found.values},
    )
