"""The linear demands, and the limits of a law."""

import dataclasses

from scripts.stage_files import stage_scenario
from straightcomp_ros.control.laws import make_law
from straightcomp_ros.control.margins import loop_margins, missing_margin
from straightcomp_ros.tuning.design.gains import closed_form, scaled, with_gains
from straightcomp_ros.tuning.design.stability import Demands, StabilityCheck, failing_limits

OF_A_SEARCH = {
    "bandwidth": 305.62,
    "third_pole": 0.33874,
    "delay": 0.88,
    "surface": 481.23,
    "reaching": 1925.7,
    "gain_allowance": 1.8527,
}
"""Found for an encoder of 5 nm by a search that did not look at the measured current."""


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


def test_gains_for_a_fine_encoder_that_hold_without_the_measured_current_may_not_hold_with_it():
    scenario = stage_scenario("fine_encoder")
    gains = {f"control.smc_observer.{name}": value for name, value in OF_A_SEARCH.items()}
    control = with_gains(scenario.controls["smc_observer"], "smc_observer", gains)
    missed = StabilityCheck(scenario.description).missed(control)
    assert missed and all("amplifier" in name or "current measured" in name for name in missed)
    refused = missing_margin(control, scenario.description)
    assert refused is not None and "at its stiffest, with the coils' current measured, stable up to 1.0" in refused
    stiff = failing_limits(scenario, control)["stiff"]
    assert stiff.gain_high > 1.9 and stiff.amplifier_high < 1.1


def test_the_loop_is_unstable_just_outside_its_mass_limits(shipped):
    limits = failing_limits(shipped, control_of(shipped))
    assert set(limits) == {"quiet", "stiff"}
    stage, law = shipped.description, make_law(control_of(shipped), shipped.description)
    for end in (limits["quiet"].mass_low, limits["quiet"].mass_high):
        for factor, stable in ((0.99 * end, end > 1.0), (1.01 * end, end < 1.0)):
            platform = dataclasses.replace(stage.platform, mass=factor * stage.platform.mass)
            margins = loop_margins(law, dataclasses.replace(stage, platform=platform))
            assert (abs(margins.poles).max() < 1.0) == stable
