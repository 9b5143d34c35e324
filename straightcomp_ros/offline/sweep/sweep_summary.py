"""The figures of a sweep: percentiles of the error under each law, failures, limit cycles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from straightcomp_ros.offline.sweep.trial import TrialResult

PERCENTILES = {"p5": 5.0, "p50": 50.0, "p95": 95.0, "max": 100.0}
"""What is told of a distribution, by name. Each is a trial that was run: nothing is interpolated."""


@dataclass(frozen=True)
class LawSummary:
    """What a sweep says of one law, failed trials included.

    Attributes:
        law: its name.
        trials: how many machines it ran on.
        pp, rms: percentiles of the true compensation error by name, m; infinite where cycles broke off.
        control_activity: percentiles of Σ |Δ i_c|, A.
        failures: failed trials, by reason.
        limit_cycles: trials with a limit cycle, failed ones included.
        worst_trial: number of the trial with the largest peak-to-peak error.
    """

    law: str
    trials: int
    pp: dict[str, float]
    rms: dict[str, float]
    control_activity: dict[str, float]
    failures: dict[str, int]
    limit_cycles: int
    worst_trial: int

    def to_display(self) -> dict[str, Any]:
        """The figures as a person reads them: lengths in µm; None where they are infinite."""
        return {
            "pp_um": _shown(self.pp, 1e6),
            "rms_um": _shown(self.rms, 1e6),
            "control_activity_A": _shown(self.control_activity, 1.0),
            "failures": sum(self.failures.values()),
            "failures_by_reason": self.failures,
            "limit_cycles": self.limit_cycles,
            "worst_trial": self.worst_trial,
        }


def summarise(results: Iterable[TrialResult]) -> list[LawSummary]:
    """One summary for each law, in the order in which they first appear."""
    by_law: dict[str, list[TrialResult]] = {}
    for result in results:
        by_law.setdefault(result.law, []).append(result)
    return [_summary(law, trials) for law, trials in by_law.items()]


def _summary(law: str, trials: Sequence[TrialResult]) -> LawSummary:
    failures: dict[str, int] = {}
    for trial in trials:
        if trial.failure:
            failures[trial.failure] = failures.get(trial.failure, 0) + 1
    return LawSummary(
        law=law,
        trials=len(trials),
        pp=_percentiles([trial.pp for trial in trials]),
        rms=_percentiles([trial.rms for trial in trials]),
        control_activity=_percentiles([trial.control_activity for trial in trials]),
        failures=failures,
        limit_cycles=sum(trial.limit_cycle for trial in trials),
        worst_trial=max(trials, key=lambda trial: trial.pp).trial,
    )


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    # Interpolation between a number and infinity would be NaN.
    found = np.percentile(values, list(PERCENTILES.values()), method="inverted_cdf")
    return dict(zip(PERCENTILES, found.tolist(), strict=True))


def _shown(percentiles: dict[str, float], unit: float) -> dict[str, float | None]:
    return {name: value * unit if math.isfinite(value) else None for name, value in percentiles.items()}
