"""Verification of gains on uncertain machines: a sweep, and which of its machines oscillate or fail."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.offline.scenario import Scenario
from straightcomp_ros.tuning.sweep.many_trials import LawSummary, summarise, sweep


@dataclass(frozen=True)
class Verification:
    """A sweep of one law.

    Attributes:
        summary: percentiles, and the machines that are not in order.
    """

    summary: LawSummary

    @property
    def misses(self) -> int:
        """Machines that are not in order."""
        return len(self.summary.not_in_order)

    @property
    def holds(self) -> bool:
        """Whether all machines are in order."""
        return self.misses == 0


def verify(
    scenario: Scenario,
    control: ControlParameters,
    *,
    machines: int,
    seed: int = 1,
    jobs: int = -1,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Verification:
    """Run ``control`` on ``machines`` of the scenario's uncertainty; `seed`, `jobs`, `progress` as in `sweep`."""
    alone = dataclasses.replace(scenario, controls={control.law: control})
    results = sweep(alone, seed, range(machines), jobs=jobs, progress=progress)
    return Verification(summarise(results)[0])
