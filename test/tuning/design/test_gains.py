"""The closed form, what follows from the stage, the linear demands, gains that hold them, and a safe law."""

import dataclasses
import math
import re

import numpy as np
import pytest

from scripts.stage_files import stage_names, stage_scenario
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law
from straightcomp_ros.control.margins import (
    closed_loop,
    linearised,
    loop_margins,
    missing_margin,
    sampled_plant,
)
from straightcomp_ros.model.modes import ModeParameters
from straightcomp_ros.offline.scenario import laws_of, make_scenario
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import Factors, StageParameters, deviating
from straightcomp_ros.tuning.design import feasible_gains as module
from straightcomp_ros.tuning.design.feasible_gains import LAW, DesignError, FeasibleGains, growths, refusal, safe_law
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
from straightcomp_ros.tuning.design.stability import STANDARD, Demands, StabilityCheck, corners_of, failing_limits
from straightcomp_ros.tuning.sweep.trial import run_trial

STAGE = StageParameters()
OBSERVER = "control.smc_observer."
RATES = {OBSERVER + name for name in ("bandwidth", "surface", "reaching")}


def test_the_rule_gives_the_gains_that_are_shipped_for_the_shipped_stage():
    shipped = ControlParameters().smc_observer
    for name, value in rule("smc_observer", STAGE).items():
        assert value == pytest.approx(getattr(shipped, name.removeprefix(OBSERVER)), rel=2e-3), name


def test_gains_beyond_a_parameters_range_are_refused_as_a_node_would_and_no_search_ends_there(shipped):
    beyond = {**rule("smc_observer", STAGE), OBSERVER + "velocity_share": 1.01}
    with pytest.raises(ParameterError, match=r"velocity_share.*1\.01.*allowed: >= 0 and <= 1"):
        with_gains(ControlParameters(), "smc_observer", beyond)
    assert FeasibleGains(shipped, "smc_observer").violation(beyond) == math.inf


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
    ringing = STAGE.with_modes(ModeParameters(350.0, 0.01, 1.0 / 3.0, 1.0 / 3.0))
    gains = {**rule("smc_observer", ringing), **shapes_for(ringing)["a notch"]}
    begins = starts("smc_observer", gains)
    assert len({one["control.filters.first.width"] for one in begins}) > 2
    assert {one["control.filters.first.frequency"] for one in begins} == {350.0}
    widest = max(begins, key=lambda one: one["control.filters.first.width"])
    assert widest["control.smc_observer.bandwidth"] < gains["control.smc_observer.bandwidth"]
    assert {one.step for one in SHAPES if one.name.endswith("first.frequency")} == {0.1}


def test_a_loop_that_leaves_a_mode_alone_need_not_damp_it():
    # By itself it decays with less than half of what is demanded of the rigid loop, and the loop hardly sees it.
    ringing = STAGE.with_modes(ModeParameters(180.0, 0.005, 0.03, 0.03))
    assert 2.0 * math.pi * 180.0 * 0.005 * STAGE.dead_time < 0.5 * STANDARD.decay
    control = with_gains(ControlParameters(), "smc_observer", rule("smc_observer", STAGE))
    assert StabilityCheck(ringing).violation(control) == StabilityCheck(STAGE).violation(control) == 0.0


def control_of(scenario, factor=1.0):
    gains = scaled("smc_observer", closed_form(scenario, "smc_observer"), factor)
    return with_gains(scenario.controls["smc_observer"], "smc_observer", gains)


def test_demands_are_held_within_the_margins_and_missed_by_their_names_the_more_the_farther_the_gains_are(shipped):
    demands, stage, control = Demands(), shipped.description, control_of(shipped)
    check = StabilityCheck(stage, demands)
    misses = [check.violation(control_of(shipped, factor)) for factor in (0.05, 0.1, 1.0, 1.6, 2.4)]
    assert misses[0] > misses[1] > misses[2] == 0.0 < misses[3] < misses[4]
    margins = loop_margins(make_law(control, stage), stage)
    assert check.missed(control) == []
    assert margins.gain_low < demands.gain_low and margins.gain_high > demands.gain_high
    assert margins.phase > demands.phase
    assert margins.longest_delay > (stage.uncertainty.longest_delay + demands.spare_delay) * stage.period
    assert "most gain" in StabilityCheck(stage, demands.tightened(1.5)).missed(control)
    wide = dataclasses.replace(stage, uncertainty=dataclasses.replace(stage.uncertainty, mass=0.6))
    assert any(name.startswith("corner mass × 0.4") for name in StabilityCheck(wide).missed(control))


def of_a_search(stage, **gains):
    """The scenario of a stage, and a control with gains that a search found for it."""
    scenario = stage_scenario(stage)
    gains = {OBSERVER + name: value for name, value in gains.items()}
    return scenario, with_gains(scenario.controls["smc_observer"], "smc_observer", gains)


def test_gains_for_a_fine_encoder_that_hold_without_the_measured_current_may_not_hold_with_it():
    # Of a search that did not look at the measured current, for an encoder of 5 nm.
    scenario, control = of_a_search(
        "fine_encoder",
        bandwidth=305.62, third_pole=0.33874, delay=0.88, surface=481.23, reaching=1925.7, gain_allowance=1.8527,
    )  # fmt: skip
    missed = StabilityCheck(scenario.description).missed(control)
    assert missed and all("amplifier" in name or "current measured" in name for name in missed)
    refused = missing_margin(control, scenario.description)
    assert refused is not None and "at its stiffest, with the coils' current measured, stable up to 1.0" in refused
    stiff = failing_limits(scenario.description, control)["stiff"]
    assert stiff.gain_high > 1.9 and stiff.amplifier_high < 1.1


def test_gains_are_not_admitted_whose_stiffest_loop_is_unstable_where_commands_act_sooner_than_described():
    """At 1 kHz a command acts a sample late as described, and from 0.2 to 1.5 by the uncertainty."""
    scenario, control = of_a_search(
        "rate_1_khz",
        bandwidth=269.2, third_pole=0.33534, delay=0.88, surface=123.4, reaching=754.37, gain_allowance=1.7838,
        velocity_share=0.34645, first_size=0.45, memory=9.807,
    )  # fmt: skip
    assert StabilityCheck(scenario.description).missed(control) == ["early commands, stiffest"]
    scenario = dataclasses.replace(scenario, controls={"smc_observer": control})
    # A machine that was drawn with 0.22 samples, and is lost.
    (lost,) = run_trial(scenario, laws_of(scenario), 1, 161)
    assert not lost.verdict.in_order and lost.pp > 5e-6


def test_the_loop_is_unstable_just_outside_its_mass_limits(shipped):
    limits = failing_limits(shipped.description, control_of(shipped))
    assert set(limits) == {"quiet", "stiff"}
    stage, law = shipped.description, make_law(control_of(shipped), shipped.description)
    for end in (limits["quiet"].mass_low, limits["quiet"].mass_high):
        for factor, stable in ((0.99 * end, end > 1.0), (1.01 * end, end < 1.0)):
            platform = dataclasses.replace(stage.platform, mass=factor * stage.platform.mass)
            margins = loop_margins(law, dataclasses.replace(stage, platform=platform))
            assert (abs(margins.poles).max() < 1.0) == stable


HARDLY_KNOWN = {**dict.fromkeys(("mass", "force", "air_gap"), 0.4), "friction": 3.0, "amplifier": 2.0}
DELAYS = {"shortest_delay": 0.6, "longest_delay": 1.4}


def roughly(facts=(), **changed):
    values = shipped_parameters()
    values["stage"] |= {"platform.stop": 8e-4, **dict(facts)}
    ranges = {**HARDLY_KNOWN, **DELAYS, **changed}
    values["stage"] |= {f"uncertainty.{name}": value for name, value in ranges.items()}
    return make_scenario(values, [LAW])


@pytest.fixture(scope="module")
def safe():
    return safe_law(roughly())


def test_the_law_is_stable_on_machines_anywhere_within_the_uncertainty(safe):
    stage = roughly().description
    law = linearised(make_law(with_gains(ControlParameters(), LAW, safe.values), stage))
    random = np.random.default_rng(1)
    radii = []
    for _ in range(200):
        mass, force, gap = (1.0 + 0.4 * random.uniform(-1.0, 1.0, 3)).tolist()
        machine = deviating(stage.plant, Factors(mass, force, gap, amplifier=2.0 ** random.uniform(-1.0, 1.0)))
        one = dataclasses.replace(stage, platform=machine.platform, actuator=machine.actuator, drive=machine.drive)
        plant = sampled_plant(one, random.uniform(0.6, 1.4) * stage.period)
        radii.append(np.abs(np.linalg.eigvals(closed_loop(plant, law))).max())
    assert max(radii) <= np.exp(-safe.decay * stage.period) + 1e-9


def test_it_says_which_corner_is_the_worst_and_how_far_friction_lets_it_go_and_gains_beyond_their_ranges_are_no_law(
    safe,
):
    assert safe.corners == 32 and safe.decay > 3.0
    assert re.fullmatch(r"mass × 1.4, force × 0.6, gap × \S+, amplifier × \S+, delay × 1.4", safe.worst)
    assert 1e-6 < safe.excursion < 1e-4 and safe.pp > 1e-6
    # What is known has no corners.
    assert len(corners_of(roughly(mass=0.0, force=0.0, amplifier=1.0).description)) == 4
    usual = make_scenario(shipped_parameters(), [LAW])
    corners = corners_of(usual.description)
    assert max(growths(usual, corners, safe.values)) < 0.0
    assert set(growths(usual, corners, {**safe.values, "control.smc.velocity_bandwidth": 2e6})) == {math.inf}


def test_a_platform_without_friction_that_the_encoders_rounding_keeps_swinging_has_a_safe_law():
    air_bearing = {"friction.coulomb": 0.0, "friction.static": 0.0, "encoder.y_resolution": 1.6e-7}
    found = safe_law(roughly({**air_bearing, "drive.bandwidth": 797.5, "drive.delay": 0.677}))
    assert found.decay > 3.0 and found.pp < 1e-5


@pytest.mark.nightly
def test_a_machine_of_which_too_little_is_known_is_refused_with_what_would_help():
    with pytest.raises(DesignError, match=r"must be known better: the mass within ± 0\.\d+ of it, or the air gap"):
        safe_law(roughly(mass=0.7, force=0.7, longest_delay=2.4))


def test_a_mode_that_the_safe_law_leaves_alone_does_not_count_however_slowly_it_decays_and_one_that_it_excites_does(
    safe,
):
    def decay(frequency, encoder):
        mode = {"frequency": frequency, "damping": 0.001, "coil": 0.1, "encoder": encoder}
        ringing = roughly({f"platform.modes.first.{name}": value for name, value in mode.items()})
        corners = module._corners(ringing.description)
        assert len(corners) == 32 + 3
        return -max(growths(ringing, corners, safe.values)) * ringing.description.rate

    assert decay(500.0, 0.02) == pytest.approx(safe.decay, rel=1e-6)
    assert decay(80.0, -1.0) < 0.0


def test_gains_that_miss_little_are_corrected_without_a_simulation(shipped):
    fast = scaled("smc_observer", closed_form(shipped, "smc_observer"), 1.5)
    check, control = StabilityCheck(shipped.description), shipped.controls["smc_observer"]
    assert check.violation(with_gains(control, "smc_observer", fast)) > 0.0
    safe = FeasibleGains(shipped, "smc_observer").near(fast)
    assert safe is not None and check.violation(with_gains(control, "smc_observer", safe)) == 0.0


def test_changes_that_would_not_do_are_not_named(infeasible, monkeypatch):
    monkeypatch.setattr(module, "_EVALUATIONS", 20)
    stage = infeasible.description
    light = infeasible.on(dataclasses.replace(stage, platform=dataclasses.replace(stage.platform, mass=0.01)))
    assert "no single change would do" in str(refusal(light, "linear"))
