"""The machines of a sweep, and what becomes of each law on them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import SeedSequence, default_rng

from scripts import late_commands as script
from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping, to_mapping
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters, UncertaintyParameters
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey
from straightcomp_ros.straightness.survey import read_survey
from straightcomp_ros.tuning.commissioning.acceptance import stalled
from straightcomp_ros.tuning.sweep.trial import draw, mismeasured, run_trials, sample_times, streams

STAGE = StageParameters()
EXACT = UncertaintyParameters(
    mass=0.0, force=0.0, air_gap=0.0, friction=1.0, sensor_noise=0.0, shortest_delay=1.0, longest_delay=1.0, jitter=0.0,
    map_noise=0.0,
)  # fmt: skip
"""The machine that the controller was designed for."""
HIGH_GAIN = {"control.smc.phi": 300.0, "control.smc.rho": 3.0}
SURVEY = read_survey(find_survey(MapParameters().file))
PERIOD = 500_000
CONTACT = "simulated.truth.contact"


def within(uncertainty: UncertaintyParameters, values: dict[str, dict], delay: float = 0.5) -> dict[str, dict]:
    """``values`` by node, with the uncertainty, and commands ``delay`` samples late."""
    described = {f"uncertainty.{name}": value for name, value in to_mapping(uncertainty).items()}
    stage = {**values.get("stage", {}), **described, "drive.delay": delay}
    return {**values, "stage": stage}


def test_the_random_numbers_of_a_trial_are_those_of_the_seeds_child():
    child = SeedSequence(8).spawn(5)[3]
    expected = [default_rng(part).random() for part in child.spawn(4)]
    assert [stream.random() for stream in streams(8, 3)] == expected


@given(st.integers(0, 2**32), st.integers(0, 10**6))
def test_every_machine_lies_within_the_ranges(seed, trial):
    factors, sensor_noise, delay = draw(STAGE, streams(seed, trial).machine)
    for name, low, high in (("mass", 0.8, 1.2), ("force", 0.8, 1.2), ("air_gap", 0.9, 1.1), ("friction", 0.5, 2.0)):
        assert low <= getattr(factors, name) <= high
    assert 0.0 <= sensor_noise <= 0.05e-6 and 0.2 <= delay <= 1.5


def test_another_range_of_one_quantity_leaves_the_others_as_they_were():
    uncertain, exact = (
        draw(from_mapping(StageParameters, given), streams(2, 7).machine) for given in ({}, {"uncertainty.mass": 0.0})
    )
    assert exact == (uncertain[0]._replace(mass=1.0), *uncertain[1:])


def test_jitter_does_not_add_up():
    stamps = sample_times(20e-6, 500_000, 10_000, default_rng(3))
    away = stamps - np.arange(10_000) * 500_000
    assert stamps[0] == 0 and np.abs(away).max() <= 20_000 and away.min() < -19_000 and away.max() > 19_000


def test_each_point_of_the_survey_errs_on_its_own():
    wrong = mismeasured(SURVEY, 0.02e-6, default_rng(4))
    errors = np.concatenate([b.deviation - a.deviation for a, b in zip(SURVEY.runs, wrong.runs, strict=True)])
    assert errors.std() == pytest.approx(0.02e-6, rel=0.1)
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < 0.15


@pytest.mark.parametrize(
    "values, message",
    [
        ({"stage": {"uncertainty.shortest_delay": 2.0}}, "longest_delay'.*>= 2.0 \\('"),
        ({"stage": {"uncertainty.air_gap": 0.5}}, "air gap × 0.5: 0.00075 m does not hold the stop"),
        ({"stage": {"uncertainty.jitter": 0.5}}, "jitter'.*<= 0.4 samples"),
        ({"controller": {"stage.rate": 1000}}, "1000 Hz; allowed: 2000 Hz"),
        ({"driver": {"simulated.command_timeout": 0.5e-3}}, "command_timeout.*>= 0.00054 s"),
    ],
)
def test_a_range_that_no_machine_can_have_and_a_scenario_that_the_kernel_does_not_hold_for_are_refused(values, message):
    with pytest.raises(ParameterError, match=message):
        make_scenario(values, ["linear"])


BLOCKS = {"model": "maxwell_slip", "bands.fraction": 0.3, "rest.growth": 0.2}
"""Friction beyond LuGre's."""


@pytest.mark.parametrize(("law", "contact"), [("smc_observer", {}), ("smc", BLOCKS)])
def test_a_trial_without_uncertainty_has_the_figures_of_the_described_machine(values, law, contact):
    values = {**within(EXACT, values), "driver": {f"{CONTACT}.{name}": value for name, value in contact.items()}}
    expected = evaluate(*run_stroke({**values, "controller": {"control.law": law}}))
    (result,) = run_trials(make_scenario(values, [law]), 1, [0])
    assert (result.pp, result.rms) == (expected.true_pp, expected.true_rms)
    assert result.control_activity == expected.control_activity
    assert result.verdict.in_order


def test_a_machine_depends_on_seed_and_number_and_not_on_the_order_of_trials_or_on_other_laws(values, scenario):
    forward, backward = run_trials(scenario, 3, [0, 1, 2]), run_trials(scenario, 3, [2, 1, 0])
    assert sorted(forward, key=repr) == sorted(backward, key=repr)
    assert len({result.pp for result in forward}) == len(forward)
    alone = run_trials(make_scenario(values, ["smc"]), 3, [1])
    assert alone == [result for result in forward if (result.law, result.trial) == ("smc", 1)]
    assert run_trials(make_scenario(values, ["smc"]), 2, [1])[0].pp != alone[0].pp


WEAK = {"actuator.current_limit": 1e-3}
"""A milliampere overcomes neither friction nor the magnets' pull a tenth of a millimetre off the centre."""


@pytest.mark.parametrize(
    ("law", "stage", "others", "delay", "verdict"),
    [
        ("linear", WEAK, {"driver": {"simulated.initial_y": 1e-4}}, 0.5, "at_stop"),
        ("smc", {"motion.stroke": 0.1}, {"controller": HIGH_GAIN}, 1.5, "oscillates"),
        ("smc", {"motion.stroke": 0.1}, {"controller": HIGH_GAIN}, 0.2, "in_order"),
        ("smc", {"motion.stroke": 1.8}, {}, 0.5, "left_map"),
        ("smc", {"motion.stroke": 1.77}, {}, 0.5, "in_order"),
    ],
)
def test_a_law_gets_the_verdict_that_its_machine_deserves(values, law, stage, others, delay, verdict):
    values = {**values, **others, "stage": {**values["stage"], **stage}}
    (result,) = run_trials(make_scenario(within(EXACT, values, delay), [law]), 1, [0])
    assert result.verdict.verdict == verdict and result.pp < np.inf


def results_on(stage, driver, machines):
    """Of the default law on these machines of a stage with other facts."""
    values = shipped_parameters()
    values["stage"] |= stage
    values["driver"] |= driver
    return run_trials(make_scenario(values, ["smc_observer"]), 1, machines)


NONE = {"friction.coulomb": 0.0, "friction.static": 0.0, "friction.viscous": 0.0}
STICKY = {"friction.bristle_stiffness": 1e8, "friction.static": 0.559}
BLOCK = {f"{CONTACT}.model": "maxwell_slip", f"{CONTACT}.maxwell_slip.blocks": 1}


@pytest.mark.parametrize(
    ("stage", "driver", "machines", "most"),
    [
        ({}, {"simulated.truth.friction": 0.05}, (30, 462, 660, 662), 0.6e-6),
        ({}, {"simulated.truth.friction": 0.001}, (308, 361, 703, 775), 0.6e-6),
        ({**NONE, "platform.stiffness": 5e4, "platform.damping": 20.0}, {}, (20, 308, 361, 941), 0.6e-6),
        # Of twice the described stiction: with a dither for the described friction these hunted, of 1,000.
        (STICKY, BLOCK, (2, 64, 263, 579), np.inf),
    ],
)
def test_no_machine_is_lost_with_little_or_no_friction_or_twice_the_described_stiction(stage, driver, machines, most):
    assert all(one.verdict.in_order and one.pp < most for one in results_on(stage, driver, machines))


def test_friction_that_the_dither_does_not_overcome_is_among_what_the_verdict_names():
    (one,) = results_on(STICKY, {**BLOCK, "simulated.truth.friction": 2.0}, [64])
    assert not one.verdict.in_order and "stage.friction" in one.verdict.reason


def test_irregular_commands_leave_more_than_regular_ones_and_a_fixed_time_of_action_takes_that_away():
    shipped = shipped_parameters()
    shipped["stage"] |= {"motion.stroke": 0.1, "drive.delay": 1.0}

    def rms(delays):
        return evaluate(*run_stroke(shipped, delays)).to_display()["true_rms_um"]

    irregular = np.random.default_rng(2).integers(0, PERIOD, 8000)
    assert rms(np.maximum(irregular, PERIOD)) == rms(np.full(8000, PERIOD))
    assert rms(irregular) > 1.02 * rms(np.full(8000, PERIOD))
    assert script.typical_delays(PERIOD).max() < PERIOD


def test_what_a_stalled_host_has_to_answer_comes_when_the_stall_is_over():
    delays = stalled(2000, PERIOD, PERIOD, 2.0, range(1000, 2000, 157))
    arrivals = (np.arange(delays.size) * PERIOD + delays)[1000:1006] // PERIOD
    assert arrivals.tolist() == [1004, 1004, 1004, 1004, 1005, 1006]


def test_a_bag_that_is_not_there_ends_the_script_with_a_sentence(tmp_path, capsys):
    assert script.main(["--bag", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
