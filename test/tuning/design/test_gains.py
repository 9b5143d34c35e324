"""The closed form, and what follows from the stage."""

import dataclasses
import math

import pytest

from scripts.stage_files import stage_names, stage_scenario
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law
from straightcomp_ros.model.modes import ModeParameters, modes_of
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.design.gains import (
    SEARCHED,
    SHAPES,
    closed_form,
    following,
    rule,
    scaled,
    shapes_for,
    starts,
    with_gains,
)
from straightcomp_ros.tuning.design.stability import STANDARD, StabilityCheck

STAGE = StageParameters()
OBSERVER = "control.smc_observer."
RATES = {OBSERVER + name for name in ("bandwidth", "surface", "reaching")}


def test_the_rule_gives_the_gains_that_are_shipped_for_the_shipped_stage():
    shipped = ControlParameters().smc_observer
    for name, value in rule("smc_observer", STAGE).items():
        assert value == pytest.approx(getattr(shipped, name.removeprefix(OBSERVER)), rel=2e-3), name


def test_a_later_command_or_a_slower_rate_makes_the_gains_slower_and_scaling_leaves_what_is_no_rate():
    gains, soon, slow = (
        rule("smc_observer", from_mapping(StageParameters, facts))
        for facts in ({}, {"drive.delay": 0.5}, {"drive.delay": 0.5, "rate": 1000})
    )
    assert all(max(gains[name], slow[name]) < soon[name] for name in RATES)
    faster = scaled("smc_observer", gains, 2.0)
    assert {name for name in gains if faster[name] != gains[name]} == RATES


@pytest.mark.parametrize("law", LAWS)
def test_what_is_searched_starts_at_the_rule_and_at_others_of_the_same_names_and_the_law_takes_it(law):
    gains = rule(law, STAGE)
    assert {gain.name for gain in SEARCHED[law]} <= set(gains)
    plain = make_law(with_gains(ControlParameters(), law, gains), STAGE)
    for name, value in gains.items():
        other = with_gains(ControlParameters(), law, {**gains, name: 1.1 * value})
        assert make_law(other, STAGE).gains != plain.gains, name
    first, *others = starts(law, gains)
    assert first == gains and others
    assert all(set(other) == set(gains) and other != gains for other in others)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", sorted(set(stage_names()) - {"infeasible"}))
def test_the_closed_form_holds_the_demands_or_is_close(law, name):
    scenario = stage_scenario(name)
    control = with_gains(scenario.controls["smc_observer"], law, closed_form(scenario, law))
    # At its stiffest the default law comes to its limits where the loop is slow compared with the magnets.
    if law == "smc_observer" and name in ("slow_amplifier", "rate_1_khz"):
        assert 0.0 < StabilityCheck(scenario.description).violation(control) < 0.05
    else:
        assert StabilityCheck(scenario.description).missed(control) == []


def test_friction_that_is_known_better_is_believed_from_the_start_and_few_reversals_are_remembered_longer(shipped):
    def first_size(friction):
        ranges = dataclasses.replace(shipped.description.uncertainty, friction=friction)
        stage = dataclasses.replace(shipped.description, uncertainty=ranges)
        return following(shipped.on(stage), "smc_observer")[OBSERVER + "first_size"]

    assert first_size(2.0) == pytest.approx(0.45)
    assert first_size(1.1) > first_size(2.0) > first_size(5.0)
    fast, usual, slow = (
        following(stage_scenario(name), "smc_observer")[OBSERVER + "memory"]
        for name in ("fast_motion", "shipped", "slow_motion")
    )
    assert slow > 2.0 * usual > 2.0 * fast
    assert following(stage_scenario("shipped"), "linear") == {}


def test_a_notch_is_tried_narrow_and_wide_with_a_slower_loop_and_its_frequency_is_hardly_moved():
    stage = STAGE
    mode = ModeParameters(350.0, 0.01, 1.0 / 3.0, 1.0 / 3.0)
    ringing = dataclasses.replace(stage, platform=dataclasses.replace(stage.platform, modes=modes_of(mode)))
    gains = {**rule("smc_observer", ringing), **shapes_for(ringing)["a notch"]}
    begins = starts("smc_observer", gains)
    assert len({one["control.filters.first.width"] for one in begins}) > 2
    assert {one["control.filters.first.frequency"] for one in begins} == {350.0}
    widest = max(begins, key=lambda one: one["control.filters.first.width"])
    assert widest["control.smc_observer.bandwidth"] < gains["control.smc_observer.bandwidth"]
    assert {one.step for one in SHAPES if one.name.endswith("first.frequency")} == {0.1}


def test_a_loop_that_leaves_a_mode_alone_need_not_damp_it():
    stage = STAGE
    # By itself it decays with less than half of what is demanded of the rigid loop, and the loop hardly sees it.
    mode = ModeParameters(180.0, 0.005, 0.03, 0.03)
    ringing = dataclasses.replace(stage, platform=dataclasses.replace(stage.platform, modes=modes_of(mode)))
    assert 2.0 * math.pi * 180.0 * 0.005 * stage.dead_time < 0.5 * STANDARD.decay
    control = with_gains(ControlParameters(), "smc_observer", rule("smc_observer", stage))
    assert StabilityCheck(ringing).violation(control) == StabilityCheck(stage).violation(control) == 0.0
