from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nominal import EXACT
from numpy.random import SeedSequence, default_rng

from straightcomp_ros.model.plant import PlantParameters
from straightcomp_ros.offline.scenario import make_scenario
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.stage.truth import deviating
from straightcomp_ros.straightness.guide_map import MapParameters, find_survey
from straightcomp_ros.straightness.survey import read_survey
from straightcomp_ros.tuning.sweep.trial import draw, mismeasured, sample_times, streams

STAGE = StageParameters()
EXACT_STAGE = replace(STAGE, uncertainty=EXACT)


def test_the_random_numbers_of_a_trial_are_those_of_the_seeds_child():
    child = SeedSequence(8).spawn(5)[3]
    expected = [default_rng(part).random() for part in child.spawn(4)]
    assert [stream.random() for stream in streams(8, 3)] == expected


@given(st.integers(0, 2**32), st.integers(0, 10**6))
def test_every_machine_lies_within_the_ranges(seed, trial):
    machine = draw(STAGE, streams(seed, trial).machine)
    assert 0.8 <= machine.mass <= 1.2
    assert 0.8 <= machine.force <= 1.2
    assert 0.9 <= machine.air_gap <= 1.1
    assert 0.5 <= machine.friction <= 2.0
    assert 0.0 <= machine.sensor_noise <= 0.05e-6
    assert 0.2 <= machine.delay <= 1.5


def test_half_of_the_machines_have_less_than_nominal_friction():
    frictions = [draw(STAGE, streams(1, trial).machine).friction for trial in range(400)]
    assert 160 < sum(friction < 1.0 for friction in frictions) < 240


def test_without_uncertainty_machine_clock_and_survey_are_nominal():
    random = streams(1, 1)
    assert deviating(PlantParameters(), draw(EXACT_STAGE, random.machine).factors) == PlantParameters()
    assert sample_times(EXACT.jitter, 500_000, 4, random.clock).tolist() == [0, 500_000, 1_000_000, 1_500_000]
    survey = read_survey(find_survey(MapParameters().file))
    for run, same in zip(survey.runs, mismeasured(survey, EXACT.map_noise, random.survey).runs, strict=True):
        np.testing.assert_array_equal(run.deviation, same.deviation)


def test_force_and_gap_change_the_stiffness_as_equation_3_says():
    nominal = PlantParameters().actuator
    machine = draw(EXACT_STAGE, default_rng(1))._replace(force=1.2, air_gap=0.9)
    changed = deviating(PlantParameters(), machine.factors).actuator
    assert changed.current_stiffness / nominal.current_stiffness == pytest.approx(1.2 / 0.9**2)
    assert changed.position_stiffness / nominal.position_stiffness == pytest.approx(1.2 / 0.9**3)


def test_another_range_of_one_quantity_leaves_the_others_as_they_were():
    machines = [
        draw(from_mapping(StageParameters, given), streams(2, 7).machine) for given in ({}, {"uncertainty.mass": 0.0})
    ]
    assert machines[1] == machines[0]._replace(mass=1.0)


def test_jitter_does_not_add_up():
    stamps = sample_times(20e-6, 500_000, 10_000, default_rng(3))
    away = stamps - np.arange(10_000) * 500_000
    assert stamps[0] == 0 and np.abs(away).max() <= 20_000 and away.min() < -19_000 and away.max() > 19_000


def test_each_point_of_the_survey_errs_on_its_own():
    survey = read_survey(find_survey(MapParameters().file))
    wrong = mismeasured(survey, 0.02e-6, default_rng(4))
    errors = np.concatenate([b.deviation - a.deviation for a, b in zip(survey.runs, wrong.runs, strict=True)])
    assert errors.std() == pytest.approx(0.02e-6, rel=0.1)
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < 0.15


@pytest.mark.parametrize(
    "ranges, message",
    [
        ({"mass": 1.5}, "mass'.*<= 0.9"),
        ({"friction": 0.5}, "friction'.*>= 1"),
        ({"shortest_delay": 2.0}, "longest_delay'.*>= 2.0 \\('"),
        ({"air_gap": 0.5}, "air gap × 0.5: 0.00075 m does not hold the stop"),
        ({"jitter": 0.5}, "jitter'.*<= 0.4 samples"),
    ],
)
def test_ranges_that_no_machine_can_have_are_refused(ranges, message):
    with pytest.raises(ParameterError, match=message):
        make_scenario({"stage": {f"uncertainty.{name}": value for name, value in ranges.items()}}, ["linear"])


@pytest.mark.parametrize(
    "values, message",
    [
        ({"controller": {"stage.rate": 1000}}, "1000 Hz; allowed: 2000 Hz"),
        ({"stage": {"rate": 50}}, "50 Hz; allowed in a sweep: >= 100"),
        ({"driver": {"simulated.command_timeout": 0.5e-3}}, "command_timeout.*>= 0.00054 s"),
    ],
)
def test_a_scenario_that_the_kernel_does_not_hold_for_is_refused(values, message):
    with pytest.raises(ParameterError, match=message):
        make_scenario(values, ["linear"])
