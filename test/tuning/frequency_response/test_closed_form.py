"""The closed form agrees with the continuous equations, with the sampled margins, and with friction's own average."""

import dataclasses
import math

import numpy as np
import pytest

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import friction_damping, loop_margins, loop_response
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response.measured_response import response_margins

STAGE = StageParameters()
GRID = np.geomspace(0.5, 990.0, 4000)


@pytest.mark.parametrize("delay", [0.3, 1.0, 1.6])
def test_far_below_the_sampling_rate_the_plant_is_that_of_the_continuous_equations(delay):
    stage = dataclasses.replace(STAGE, drive=dataclasses.replace(STAGE.drive, delay=delay))
    f = np.array([2.0, 10.0, 40.0])
    s = 2j * math.pi * f
    actuator, damping = stage.actuator, 120.0
    mechanics = actuator.current_stiffness / (stage.platform.mass * s**2 + damping * s - actuator.position_stiffness)
    amplifier = 1.0 / (1.0 + s / (2.0 * math.pi * stage.drive.bandwidth))
    held = np.exp(-s * (delay + 0.5) * stage.period)
    law = make_law(ControlParameters(law="linear"), stage)
    ratio = loop_response(law, stage, f, damping).plant / (mechanics * amplifier * held)
    np.testing.assert_allclose(ratio, 1.0, atol=5e-3)


@pytest.mark.parametrize("law", ["linear", "smc"])
def test_margins_of_the_response_are_those_of_the_closed_loops_poles(law):
    made = make_law(ControlParameters(law=law), STAGE)
    found = response_margins(GRID, loop_response(made, STAGE, GRID).open_loop)
    poles = loop_margins(made, STAGE)
    assert found.gain_low == pytest.approx(poles.gain_low, rel=2e-3)
    assert found.gain_high == pytest.approx(poles.gain_high, rel=2e-3)
    assert found.phase_deg == pytest.approx(poles.phase, abs=0.2)
    assert found.delay_us == pytest.approx((poles.longest_delay - STAGE.drive.delay * STAGE.period) * 1e6, rel=5e-3)


def test_the_measured_current_is_part_of_the_loop_of_a_law_that_answers_to_it():
    law = make_law(ControlParameters(), STAGE)
    loop = loop_response(law, STAGE, GRID)
    np.testing.assert_allclose(loop.sensitivity * (1.0 + loop.open_loop), 1.0)
    seeing = response_margins(GRID, loop.open_loop).gain_high
    assert seeing is not None
    # The observer sees a current that is too large and takes back what it did: the margin is another than without.
    assert abs(seeing / loop_margins(law, STAGE).gain_high - 1.0) > 0.02


def test_friction_damps_as_its_mean_over_a_gaussian_velocity_does():
    friction, speed = STAGE.friction, 3e-5
    v = speed * np.random.default_rng(1).standard_normal(2_000_000)
    slow = np.exp(-((v / friction.stribeck_velocity) ** 2))
    force = (friction.coulomb + (friction.static - friction.coulomb) * slow) * np.sign(v) + friction.viscous * v
    assert friction_damping(friction, speed) == pytest.approx(np.mean(v * force) / np.mean(v * v), rel=3e-3)
