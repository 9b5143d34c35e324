"""What follows from the stage without a search."""

import dataclasses

import pytest

from scripts.stage_files import stage_scenario
from straightcomp_ros.tuning.design.gains import following

OBSERVER = "control.smc_observer."


def test_friction_that_is_known_better_is_believed_from_the_start(shipped):
    def first_size(friction: float) -> float:
        ranges = dataclasses.replace(shipped.description.uncertainty, friction=friction)
        stage = dataclasses.replace(shipped.description, uncertainty=ranges)
        return following(shipped.on(stage), "smc_observer")[OBSERVER + "first_size"]

    assert first_size(2.0) == pytest.approx(0.45)
    assert first_size(1.1) > first_size(2.0) > first_size(5.0)


def test_a_stage_whose_reference_turns_over_less_often_remembers_longer():
    memories = [
        following(stage_scenario(name), "smc_observer")[OBSERVER + "memory"]
        for name in ("fast_motion", "shipped", "slow_motion")
    ]
    assert memories == sorted(memories) and memories[-1] > 2.0 * memories[1] > 2.0 * memories[0]


@pytest.mark.parametrize("law", ["linear", "smc"])
def test_laws_without_a_friction_model_have_nothing_that_follows(shipped, law):
    assert following(shipped, law) == {}
