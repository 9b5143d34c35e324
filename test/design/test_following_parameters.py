"""What follows from the stage without a search."""

import dataclasses

import numpy as np
import pytest

from scripts.stage_files import stage_scenario
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.design.automatic_design import closed_form
from straightcomp_ros.design.course import course_of
from straightcomp_ros.design.following_parameters import following
from straightcomp_ros.design.searched_gains import with_gains
from straightcomp_ros.offline.sweep.uncertainty import deviating, draw, streams

OBSERVER = "control.smc_observer."


def test_friction_that_is_known_better_is_believed_from_the_start(shipped):
    def first_size(friction: float) -> float:
        ranges = dataclasses.replace(shipped.uncertainty, friction=friction)
        return following(dataclasses.replace(shipped, uncertainty=ranges), "smc_observer")[OBSERVER + "first_size"]

    assert first_size(2.0) == pytest.approx(0.45)
    assert first_size(1.1) > first_size(2.0) > first_size(5.0)


def test_a_stage_whose_reference_turns_over_less_often_remembers_longer():
    memories = [
        following(stage_scenario(name), "smc_observer")[OBSERVER + "memory"]
        for name in ("fast_motion", "shipped", "slow_motion")
    ]
    assert memories == sorted(memories) and memories[-1] > 2.0 * memories[1] > 2.0 * memories[0]


def test_the_band_at_rest_is_two_counts(fine):
    assert following(fine, "smc_observer")[OBSERVER + "rest_band"] == pytest.approx(10e-9)


def test_the_fit_trusts_the_stiffness_the_more_the_heavier_the_platform(shipped):
    heavy = stage_scenario("heavy_platform")
    light, heavier = (following(one, "smc_observer")[OBSERVER + "fit_travel"] for one in (shipped, heavy))
    assert heavier == pytest.approx(20.0 / 3.0 * light) and light == pytest.approx(1e-4, rel=0.02)


@pytest.mark.parametrize("law", ["linear", "smc"])
def test_laws_without_a_friction_model_have_nothing_that_follows(shipped, law):
    assert following(shipped, law) == {}


def test_with_large_friction_the_first_reversals_need_a_fit_that_trusts_the_stiffness():
    sticky = stage_scenario("sticky")
    course, period = course_of(sticky), sticky.period_ns * 1e-9
    values = closed_form(sticky, "smc_observer")
    machines = [deviating(course.plant, draw(sticky.uncertainty, streams(1, trial).machine)) for trial in range(6)]

    def error(travel: float) -> float:
        control = with_gains(
            sticky.controls["smc_observer"], "smc_observer", {**values, OBSERVER + "fit_travel": travel}
        )
        law = make_law(control, period)
        return float(np.mean([course.run(law, period, plant=machine).pp for machine in machines]))

    assert error(values[OBSERVER + "fit_travel"]) < 0.6 * error(25e-6)
