import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.laws import LAWS, ControlParameters, ObserverDesign, make_law
from straightcomp_ros.offline.simulation import Simulation
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
OBSERVER_LAWS = ("smc_observer",)


def run(**controller):
    values = shipped_parameters()
    values["controller"].update({key.replace("__", "."): value for key, value in controller.items()})
    delay = controller.get("control__smc_observer__delay", 0.5)
    values["stage"].update(
        {"drive.delay": delay, "motion.stroke": 0.6, "motion.settle": 0.3, "motion.pause": 0.1},
    )
    simulation = Simulation(values)
    record = simulation.run()
    return record, evaluate(record, simulation.map)


@pytest.mark.parametrize("law", OBSERVER_LAWS)
@given(y=st.floats(-2e-3, 2e-3), r=st.floats(-1e-4, 1e-4), rate=st.floats(-1e-3, 1e-3))
def test_every_command_is_finite_and_within_its_limit_wherever_the_platform_is(law, y, r, rate):
    servo = make_law(ControlParameters(law=law), from_mapping(StageParameters, {"actuator.current_limit": 0.4}))
    servo.reset(y)
    for reading in (y, -y, 0.0, y):
        command = servo.step(reading, r, rate, 0.0)
        assert math.isfinite(command.current) and abs(command.current) <= 0.4
        assert command.error == r - reading


@pytest.mark.no_cover  # whole strokes, which take three times as long under it
def test_the_laws_rank_as_their_designs_promise():
    errors = {law: run(control__law=law)[1].true_pp for law in LAWS}
    assert errors["smc_observer"] < errors["smc"] < errors["linear"]
    assert errors["smc_observer"] < 0.17e-6


@pytest.mark.no_cover  # whole strokes, which take three times as long under it
def test_the_observer_law_works_with_a_sample_of_delay_that_it_knows():
    assert run(control__law="smc_observer", control__smc_observer__delay=1.0)[1].true_pp < 0.25e-6


@pytest.mark.no_cover  # whole strokes, which take three times as long under it
def test_the_printed_law_lags_and_its_feedforward_removes_the_lag():
    lagging, following = (run(control__law="smc", control__smc__feedforward=on)[1] for on in (False, True))
    assert following.true_pp < 0.8 * lagging.true_pp


@pytest.mark.no_cover  # whole strokes, which take three times as long under it
def test_the_observer_law_switches_less_than_a_quarter_of_literal_sgn():
    sgn = run(control__law="smc", control__smc__boundary_layer=0.0, control__smc__feedforward=False)[1]
    assert run(control__law="smc_observer")[1].control_activity < 0.25 * sgn.control_activity


def test_the_disturbance_estimate_is_friction_over_mass():
    record, _ = run(control__law="smc_observer")
    servo = make_law(ControlParameters(law="smc_observer"), STAGE)
    servo.reset(record.y[0])
    estimates = [servo.step(y, r, 0.0, 0.0).disturbance_estimate for y, r in zip(record.y, record.r, strict=True)]
    assert np.percentile(np.abs(estimates[2000:]), 50) < 1.0 * ObserverDesign().gain_allowance


def test_a_law_is_a_function_without_memory_of_its_own():
    law = make_law(ControlParameters(law="smc_observer"), STAGE)
    state = law.start(1e-6)
    first = law.function(law.gains, state, 1.1e-6, 0.0, 0.0, 0.0, 0.0)
    assert law.function(law.gains, state, 1.1e-6, 0.0, 0.0, 0.0, 0.0) == first
    assert replace(ControlParameters(), law="linear").law == "linear"
