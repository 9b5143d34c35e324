"""Late commands cost what the stroke says in simulation, and infinitely much where the platform is lost."""

import math

import numpy as np
import pytest
from roughly_known import values_of

from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.tuning.commissioning import timing_budget
from straightcomp_ros.tuning.commissioning.timing_budget import allowed_cost_um


def test_a_platform_that_late_commands_lose_costs_infinitely_much(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(values, delays=None):
        if delays is not None:
            raise ValueError("position or control current is not finite")
        return run_stroke(values)

    monkeypatch.setattr(timing_budget, "run_stroke", lost)
    found = timing_budget.timing_budget(values_of(motion__stroke=0.1), np.full(1000, 6e-4), 2e-4)
    assert found["as_measured_costs_um"] == found["p99_costs_um"] == math.inf
    assert set(found["stall_error_um"].values()) == {math.inf} and found["longest_stall_survived_ms"] == 0
    assert math.isfinite(found["in_time_pp_um"])


def test_commands_in_time_cost_nothing_and_commands_without_latencies_are_not_judged() -> None:
    values = values_of(motion__stroke=0.1)
    early = timing_budget.timing_budget(values, np.array([1e-4, math.nan, 5e-4]), 2e-4)
    assert early["as_measured_costs_um"] == early["p99_costs_um"] == 0.0
    assert "as_measured_costs_um" not in timing_budget.timing_budget(values, np.full(5, math.nan), 2e-4)


def test_late_commands_may_double_the_error_or_add_a_count() -> None:
    assert allowed_cost_um({"in_time_pp_um": 0.25}, 1e-7) == 0.25
    assert allowed_cost_um({"in_time_pp_um": 0.05}, 1e-7) == pytest.approx(0.1)
