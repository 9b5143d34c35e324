"""Gains that hold linear demands are found, or a refusal says what would do; a hardly known machine gets a safe law."""

import dataclasses
import math
import re

import numpy as np
import pytest

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import closed_loop, linearised, sampled_plant
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import Factors, deviating
from straightcomp_ros.tuning.design import feasible_gains as module
from straightcomp_ros.tuning.design.feasible_gains import LAW, DesignError, FeasibleGains, growths, refusal, safe_law
from straightcomp_ros.tuning.design.gains import closed_form, scaled, with_gains
from straightcomp_ros.tuning.design.stability import StabilityCheck, corners_of

HARDLY_KNOWN = {**dict.fromkeys(("mass", "force", "air_gap"), 0.4), "friction": 3.0, "amplifier": 2.0}
DELAYS = {"shortest_delay": 0.6, "longest_delay": 1.4}


def scenario(facts=(), **changed):
    values = shipped_parameters()
    values["stage"] |= {"platform.stop": 8e-4, **dict(facts)}
    ranges = {**HARDLY_KNOWN, **DELAYS, **changed}
    values["stage"] |= {f"uncertainty.{name}": value for name, value in ranges.items()}
    return make_scenario(values, [LAW])


@pytest.fixture(scope="module")
def found():
    return safe_law(scenario())


def test_the_law_is_stable_on_machines_anywhere_within_the_uncertainty(found):
    stage = scenario().description
    law = linearised(make_law(with_gains(ControlParameters(), LAW, found.values), stage))
    random = np.random.default_rng(1)
    radii = []
    for _ in range(200):
        mass, force, gap = (1.0 + 0.4 * random.uniform(-1.0, 1.0, 3)).tolist()
        machine = deviating(stage.plant, Factors(mass, force, gap, amplifier=2.0 ** random.uniform(-1.0, 1.0)))
        one = dataclasses.replace(stage, platform=machine.platform, actuator=machine.actuator, drive=machine.drive)
        plant = sampled_plant(one, random.uniform(0.6, 1.4) * stage.period)
        radii.append(np.abs(np.linalg.eigvals(closed_loop(plant, law))).max())
    assert max(radii) <= np.exp(-found.decay * stage.period) + 1e-9


def test_it_says_which_corner_is_the_worst_and_how_far_friction_lets_it_go_and_gains_beyond_their_ranges_are_no_law(
    found,
):
    assert found.corners == 32 and found.decay > 3.0
    assert re.fullmatch(r"mass × 1.4, force × 0.6, gap × \S+, amplifier × \S+, delay × 1.4", found.worst)
    assert 1e-6 < found.excursion < 1e-4 and found.pp > 1e-6
    usual = make_scenario(shipped_parameters(), [LAW])
    corners = corners_of(usual.description)
    assert max(growths(usual, corners, found.values)) < 0.0
    assert set(growths(usual, corners, {**found.values, "control.smc.velocity_bandwidth": 2e6})) == {math.inf}


@pytest.mark.nightly
def test_a_machine_of_which_too_little_is_known_is_refused_with_what_would_help():
    with pytest.raises(DesignError, match=r"must be known better: the mass within ± 0\.\d+ of it, or the air gap"):
        safe_law(scenario(mass=0.7, force=0.7, longest_delay=2.4))


def test_a_mode_that_the_safe_law_leaves_alone_does_not_count_however_slowly_it_decays_and_one_that_it_excites_does(
    found,
):
    def decay(frequency, encoder):
        mode = {"frequency": frequency, "damping": 0.001, "coil": 0.1, "encoder": encoder}
        ringing = scenario({f"platform.modes.first.{name}": value for name, value in mode.items()})
        corners = module._corners(ringing.description)
        assert len(corners) == 32 + 3
        return -max(growths(ringing, corners, found.values)) * ringing.description.rate

    assert decay(500.0, 0.02) == pytest.approx(found.decay, rel=1e-6)
    assert decay(80.0, -1.0) < 0.0


def test_known_facts_are_no_corners():
    assert safe_law(scenario(mass=0.0, force=0.0, amplifier=1.0)).corners == 4


def test_gains_that_miss_little_are_corrected_without_a_simulation(shipped):
    fast = scaled("smc_observer", closed_form(shipped, "smc_observer"), 1.5)
    check, control = StabilityCheck(shipped.description), shipped.controls["smc_observer"]
    assert check.violation(with_gains(control, "smc_observer", fast)) > 0.0
    found = FeasibleGains(shipped, "smc_observer").near(fast)
    assert found is not None and check.violation(with_gains(control, "smc_observer", found)) == 0.0


def test_changes_that_would_not_do_are_not_named(infeasible, monkeypatch):
    monkeypatch.setattr(module, "_EVALUATIONS", 20)
    stage = infeasible.description
    light = infeasible.on(dataclasses.replace(stage, platform=dataclasses.replace(stage.platform, mass=0.01)))
    assert "no single change would do" in str(refusal(light, "linear"))
