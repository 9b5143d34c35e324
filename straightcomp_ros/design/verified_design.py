"""Verification of gains on uncertain machines: a sweep, and which of its machines oscillate or fail."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.design.judged_gains import oscillation_limit
from straightcomp_ros.offline.sweep.many_trials import LawSummary, summarise, sweep
from straightcomp_ros.offline.sweep.scenario import Scenario


@dataclass(frozen=True)
class Verification:
    """A sweep of one law.

    Attributes:
        summary: percentiles, failures, limit cycles of 0.1 µm or a count.
        oscillating: numbers of the machines on which a held line makes most of the error.
    """

    summary: LawSummary
    oscillating: tuple[int, ...]

    @property
    def holds(self) -> bool:
        """Whether no machine failed or oscillated."""
        return not (self.summary.failures or self.summary.limit_cycles or self.oscillating)

    @property
    def misses(self) -> int:
        """Machines that failed, or oscillated."""
        return sum(self.summary.failures.values()) + max(self.summary.limit_cycles, len(self.oscillating))


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
    count = scenario.driver.simulated.plant.encoder.resolution
    oscillating = tuple(one.trial for one in results if one.oscillation > oscillation_limit(one.pp, count))
    return Verification(summarise(results)[0], oscillating)
