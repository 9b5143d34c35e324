import numpy as np
import pytest
from nominal import EXACT, within

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.scenario import laws_of, make_scenario
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.tuning.sweep.many_trials import run_trials
from straightcomp_ros.tuning.sweep.trial import run_trial


@pytest.mark.parametrize("law", LAWS)
def test_a_trial_without_uncertainty_has_the_figures_of_the_simulation(values, law):
    values = within(EXACT, values)
    simulation = Simulation({**values, "controller": {"control.law": law}})
    expected = evaluate(simulation.run(), simulation.map)
    (result,) = run_trials(make_scenario(values, [law]), 1, [0])
    assert (result.pp, result.rms) == (expected.true_pp, expected.true_rms)
    assert result.control_activity == expected.control_activity
    assert result.verdict.in_order


def test_a_trial_draws_its_machine_with_the_friction_beyond_lugre(values):
    friction = {"model": "maxwell_slip", "bands.fraction": 0.3, "rest.growth": 0.2}
    driver = {f"simulated.truth.contact.{name}": value for name, value in friction.items()}
    values = within(EXACT, values)
    simulation = Simulation({**values, "driver": driver, "controller": {"control.law": "smc"}})
    expected = evaluate(simulation.run(), simulation.map)
    (result,) = run_trials(make_scenario({**values, "driver": driver}, ["smc"]), 1, [0])
    (plain,) = run_trials(make_scenario(values, ["smc"]), 1, [0])
    assert result.pp == expected.true_pp != plain.pp


def test_trials_do_not_depend_on_their_order(scenario):
    forward, backward = run_trials(scenario, 3, [0, 1, 2]), run_trials(scenario, 3, [2, 1, 0])
    assert sorted(forward, key=repr) == sorted(backward, key=repr)
    assert len({result.pp for result in forward}) == len(forward)


def test_a_law_meets_the_same_machine_whichever_laws_run_beside_it(values, scenario):
    alone = run_trials(make_scenario(values, ["smc"]), 3, [4])
    assert alone == [result for result in run_trials(scenario, 3, [4]) if result.law == "smc"]


def test_another_seed_is_another_machine(scenario):
    laws = laws_of(scenario)
    first, second = (run_trial(scenario, laws, seed, 0)[0] for seed in (1, 2))
    assert first.pp != second.pp


def test_a_platform_that_falls_onto_its_stop_is_at_the_stop(values):
    # A milliampere does not hold it against the magnets' pull a tenth of a millimetre off the centre.
    values["stage"]["actuator.current_limit"] = 1e-3
    values["driver"] = {"simulated.initial_y": 1e-4}
    (result,) = run_trials(make_scenario(within(EXACT, values), ["linear"]), 1, [0])
    assert result.verdict.verdict == "at_stop"
    assert result.pp < np.inf


def test_a_platform_that_a_weak_law_cannot_move_is_saturated(values):
    # A milliampere does not overcome friction.
    values["stage"]["actuator.current_limit"] = 1e-3
    values["stage"]["motion.stroke"] = 1.2
    (result,) = run_trials(make_scenario(within(EXACT, values), ["linear"]), 1, [0])
    assert result.verdict.verdict == "saturated"


def test_a_law_that_switches_with_sgn_limit_cycles(values):
    values["stage"]["motion.stroke"] = 0.1
    values["controller"] = {"control.smc.boundary_layer": 0.0}
    (result,) = run_trials(make_scenario(within(EXACT, values), ["smc"]), 1, [0])
    assert result.verdict.verdict == "oscillates"


def test_a_gain_too_high_for_the_delay_limit_cycles_where_half_the_delay_does_not(values):
    values["stage"]["motion.stroke"] = 0.1
    values["controller"] = {"control.smc.phi": 300.0, "control.smc.rho": 3.0}
    late, early = (run_trials(make_scenario(within(EXACT, values, delay), ["smc"]), 1, [0])[0] for delay in (1.5, 0.2))
    assert late.verdict.verdict == "oscillates" and early.verdict.in_order


@pytest.mark.parametrize("law", LAWS)
def test_each_law_is_in_order_on_the_machine_that_it_was_designed_for(values, law):
    values["stage"]["motion.stroke"] = 0.1
    (result,) = run_trials(make_scenario(within(EXACT, values), [law]), 1, [0])
    assert result.verdict.in_order


def test_a_stage_that_leaves_the_survey_left_the_map(values):
    values["stage"]["motion.stroke"] = 1.8
    (result,) = run_trials(make_scenario(within(EXACT, values), ["smc"]), 1, [0])
    assert result.verdict.verdict == "left_map"
    values["stage"]["motion.stroke"] = 1.77
    (result,) = run_trials(make_scenario(within(EXACT, values), ["smc"]), 1, [0])
    assert result.verdict.in_order
