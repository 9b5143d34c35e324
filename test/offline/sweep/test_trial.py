import numpy as np
import pytest
from nominal import EXACT, within

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.offline.sweep.many_trials import run_trials
from straightcomp_ros.offline.sweep.scenario import make_scenario
from straightcomp_ros.offline.sweep.trial import laws_of, run_trial


@pytest.mark.parametrize("law", LAWS)
def test_a_trial_without_uncertainty_has_the_figures_of_the_simulation(values, law):
    values = within(EXACT, values)
    simulation = Simulation({**values, "controller": {"control.law": law}})
    expected = evaluate(simulation.run(), simulation.map)
    (result,) = run_trials(make_scenario(values, [law]), 1, [0])
    assert (result.pp, result.rms) == (expected.true_pp, expected.true_rms)
    assert result.control_activity == expected.control_activity
    assert result.failure == "" and not result.limit_cycle


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


def test_a_platform_that_falls_onto_its_stop_has_failed(values):
    # A milliampere does not hold it against the magnets' pull a tenth of a millimetre off the centre.
    values["stage"]["actuator.current_limit"] = 1e-3
    values["driver"] = {"simulated.initial_y": 1e-4}
    (result,) = run_trials(make_scenario(within(EXACT, values), ["linear"]), 1, [0])
    assert result.failure == "mechanical stop"
    assert result.pp < np.inf


def test_a_platform_that_does_not_follow_has_failed(values):
    # A milliampere does not overcome friction, and the reference moves on by more than the limit.
    values["stage"]["actuator.current_limit"] = 1e-3
    values["stage"]["motion.stroke"] = 1.2
    (result,) = run_trials(make_scenario(within(EXACT, values), ["linear"]), 1, [0])
    assert result.failure == "error beyond 10 µm"
