"""The gains of a law from the description of a stage, with what they promise and where they fail.

    found = design_gains(make_scenario(values, ["smc_observer"]), "smc_observer", quiet=0.3)
    found.values        # {'control.smc_observer.bandwidth': 231.4, …}

1. A closed form gives a start (`gains.py`): for a platform with modes one with a notch for each, one with a roll-off
   and one without either, which is left with less bandwidth. All that can hold the demands are searched.
2. If it misses the linear demands (`stability.py`) and no gains hold them, the stage is refused (`feasible_gains.py`).
3. CMA-ES looks for the least cost (`gain_search.py`).
4. The best candidates run the whole stroke from more starts; the best of them is verified on uncertain machines, by a
   sweep. If one of these fails, the demands are tightened, and the search goes on.
5. The budget and the limits of the result are computed (`error_budget.py`, `stability.py`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from straightcomp_ros.control.laws import make_law
from straightcomp_ros.doctor import Finding
from straightcomp_ros.doctor.stage_findings import stiction
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.offline.starts import STARTS, Spread, spread
from straightcomp_ros.parameters.node_parameters import ControllerNodeParameters
from straightcomp_ros.tuning.design.error_budget import BudgetEntry, error_budget
from straightcomp_ros.tuning.design.feasible_gains import FeasibleGains, refusal
from straightcomp_ros.tuning.design.gain_search import UNEVEN, Judge, Judged, RunFigures, prepared_stroke, search
from straightcomp_ros.tuning.design.gains import closed_form, shapes_for, starts, with_gains
from straightcomp_ros.tuning.design.stability import STANDARD, FailingLimits, failing_limits
from straightcomp_ros.tuning.sweep.trial import LawSummary, summarise, sweep

SHIPPED_QUIET = 0.3
"""Weight of quiet coils against accuracy, unless another one is asked for."""
_EVALUATIONS = 400
_WITH_MODES = 400
"""Of linear demands alone, per start: modes leave the gains a narrower valley."""
_MACHINES = 200
_ROUNDS = 3
_TIGHTER = 1.1
_FINALISTS = 4


class DesignFigures(NamedTuple):
    """Figures on the stage as described, over some starts: true error p-p and RMS in m; RMS step of the current from
    sample to sample in A, while the stage moves and at rest."""

    pp: Spread
    rms: Spread
    work: Spread
    rest_work: Spread


@dataclass(frozen=True, eq=False)
class Design:
    """A design."""

    law: str
    values: Mapping[str, float]  # gains, by dotted name in the node controller
    lead: float  # s; the references have to be as new
    figures: DesignFigures  # what is predicted
    start_values: Mapping[str, float]  # those of the closed form
    start_figures: DesignFigures
    quiet: float  # the trade that was asked for
    verification: LawSummary  # sweep over uncertain machines
    rounds: int  # searches, more than one if the first result failed on an uncertain machine
    budget: Sequence[BudgetEntry]  # what limits the error, the stage as described first
    limits: Mapping[str, FailingLimits]  # until where the linear loop is stable, by the law's state
    shape: str  # how the platform's modes are answered, in words
    stiction: Finding  # what the friction's bristles leave of it, as `straightcomp stage check` finds

    @property
    def holds(self) -> bool:
        """Whether all machines of the verification are in order."""
        return not self.verification.not_in_order

    @property
    def newer(self) -> dict[str, float]:
        """The controller's parameter for references that must be newer than usual, by its name."""
        return {"reference_lead": self.lead} if self.lead < ControllerNodeParameters.reference_lead else {}

    @property
    def warnings(self) -> list[str]:
        """What no gains can do on this stage, and what helps, a sentence each."""
        one = self.stiction
        return [] if one.state == "ok" else [f"stiction: {one.detail}. {one.remedy}"]

    def limits_to_display(self) -> dict[str, Any]:
        """What limits the design: budget, with errors in µm, and limits."""
        return {
            "budget": [{"cause": one.cause, "pp_um": one.pp * 1e6, "rms_um": one.rms * 1e6} for one in self.budget],
            "limits": {state: one._asdict() for state, one in self.limits.items()},
        }


def design_gains(
    scenario: Scenario,
    law: str = "smc_observer",
    *,
    quiet: float = SHIPPED_QUIET,
    evaluations: int = _EVALUATIONS,
    machines: int = _MACHINES,
    seed: int = 1,
    jobs: int = -1,
    progress: Callable[[str, float], None] = lambda part, fraction: None,
) -> Design:
    """Design ``law`` for the stage of ``scenario``; the gains of its controls are not read.

    Args:
        quiet: 0 for the least error, 1 for the quietest coils.
        evaluations: candidates of the first search; half as many of one after a failed verification.
        machines: of the verification.
        seed: of all random numbers; the same seed gives the same design on the same processor.
        jobs: processes; −1 takes all cores. The result does not depend on it.
        progress: called with what is being done and the fraction of it that is done.

    Raises:
        DesignError: no gains hold the demands; the message says what would have to change.
    """
    scenario = scenario.in_time()
    plain, stage = closed_form(scenario, law), scenario.description
    # Ways to answer the modes, by a name in words.
    begins = {name: {**plain, **shape} for name, shape in shapes_for(stage).items()}
    full, base = prepared_stroke(scenario), next(iter(scenario.controls.values()))

    def way(gains: Mapping[str, float]) -> str:
        return next(name for name, begin in begins.items() if begin.keys() == gains.keys())

    def runs(gains: Mapping[str, float]) -> list[RunFigures]:
        made = make_law(with_gains(base, law, gains), stage)
        return [full.run(made, stage.delay, number) for number in range(STARTS)]

    def figures(gains: Mapping[str, float]) -> DesignFigures:
        found = runs(gains)
        return DesignFigures(*(spread(getattr(run, name) for run in found) for name in DesignFigures._fields))

    def cost(one: Judged) -> float:
        """Of a finalist, on the whole stroke: short strokes may have flattered it."""
        pp = spread(run.pp for run in runs(one.gains))
        if not math.isfinite(pp.max):
            return math.inf
        # Gains that are good from some starts only are worth what they are from the worst.
        uneven = max(1.0, pp.max / (UNEVEN * pp.median))
        return one.cost + math.log(uneven * pp.median / one.pp)

    progress("feasible", 0.0)
    verified = list[tuple[LawSummary, Mapping[str, float]]]()
    held, names, more = STANDARD, list(begins), list[dict[str, float]]()
    for rounds in range(1, _ROUNDS + 1):
        feasible = FeasibleGains(scenario, law, held, seed)
        near = {name: gains for name in names if (gains := feasible.near(begins[name], _WITH_MODES)) is not None}
        if not near:
            break
        # The first candidates take as long as many later ones: what goes on now is the search.
        progress("search", 0.0)
        judge, budget, found = Judge(scenario, law, quiet, held), evaluations // min(rounds, 2), list[Judged]()
        searched = partial(
            search, judge, seed=seed + rounds - 1, jobs=jobs, progress=lambda fraction: progress("search", fraction)
        )
        ways = [[*starts(law, begins[name]), *more, tighter] for name, tighter in near.items()]
        if len(ways) > 1:
            # Half of the candidates show which way is the best; the others go on from there.
            for one_way in ways:
                found += searched(feasible.corrected(one_way), evaluations=budget // (2 * len(ways)))
            best_so_far = min(found, key=lambda one: one.cost).gains
            ways, budget = [[begins[way(best_so_far)], dict(best_so_far)]], budget // 2
        found += searched(feasible.corrected(ways[0]), evaluations=budget)
        found.sort(key=lambda one: one.cost)
        first = [one for one in found if any(one.gains == begins[name] for name in near)]
        finalists = [one for one in (*found[:_FINALISTS], *first) if math.isfinite(one.pp)]
        best = min(finalists, key=cost, default=found[0]).gains
        trials = sweep(
            dataclasses.replace(scenario, controls={law: with_gains(base, law, best)}),
            seed,
            range(machines),
            jobs=jobs,
            progress=lambda fraction: progress("verify", fraction),
        )
        (verification,) = summarise(trials)
        verified.append((verification, best))
        if not verification.not_in_order:
            break
        held, names, more = held.tightened(_TIGHTER), [way(best)], [dict(best)]
    if not verified:
        raise refusal(scenario, law, seed)
    verification, best = min(verified, key=lambda one: len(one[0].not_in_order))
    shape = way(best)
    return Design(
        law=law,
        values=best,
        lead=scenario.lead_ns / 1e9,
        figures=figures(best),
        start_values=begins[shape],
        start_figures=figures(begins[shape]),
        quiet=quiet,
        verification=verification,
        rounds=len(verified),
        budget=error_budget(scenario, law, best, seed=seed, progress=lambda fraction: progress("budget", fraction)),
        limits=failing_limits(stage, with_gains(base, law, best)),
        shape=shape,
        stiction=stiction(stage, with_gains(base, law, best)),
    )
