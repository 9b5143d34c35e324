"""Laws linear and smc: equation (9), its limits, and the design of the surface."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.control import sliding_mode
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.sliding_mode import (
    SlidingDesign,
    closed_loop_poles,
    reaching_bound,
    state_matrices,
    switching_function,
)
from straightcomp_ros.model.actuator import ActuatorParameters, stiffness_errors
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters

T = 5e-4
DESIGN, STAGE = SlidingDesign(), StageParameters()


def limited(current):
    """The stage with another limit of the current in A, and a converter that gives as much."""
    drive = dataclasses.replace(STAGE.drive, gain=max(STAGE.drive.gain, 1.01 * current / STAGE.drive.dac_range))
    return dataclasses.replace(STAGE, actuator=ActuatorParameters(current_limit=current), drive=drive)


NARROW_DRIVE = from_mapping(StageParameters, {"drive.gain": 0.005})
"""The stage with a converter that gives less than the limit."""


def by_equation_9(x, r, rho, boundary_layer):
    """i_c by (9), written with the matrices of the paper."""
    a, b = state_matrices(STAGE)
    s = np.array([DESIGN.omega_n**2, 2 * DESIGN.zeta * DESIGN.omega_n, 1.0])
    switching = rho * switching_function(s @ x, boundary_layer)
    return float(-(s @ a @ x - s[0] * r + DESIGN.phi * (s @ x) + switching) / (s @ b))


@given(st.floats(-2e-5, 2e-5), st.floats(-2e-5, 2e-5), st.floats(-2e-5, 2e-5))
def test_a_step_is_equation_9(y0, y1, r):
    design = SlidingDesign(velocity_bandwidth=1e5, feedforward=False)
    for law, rho in (("linear", 0.0), ("smc", DESIGN.rho)):
        servo = make_law(ControlParameters(law=law, smc=design), limited(100.0))
        servo.reset(y0)
        servo.step(y0, r, 0.0, 0.0)
        answer = servo.step(y1, r, 0.0, 0.0)
        smoothing = 1 - math.exp(-2 * math.pi * 1e5 * T)
        x = np.array([T * (y0 - r), y1, smoothing * (y1 - y0) / T])
        assert answer.current == pytest.approx(by_equation_9(x, r, rho, DESIGN.boundary_layer), rel=1e-9, abs=1e-12)
        assert answer.error == r - y1


@given(st.floats(-1e-2, 1e-2), st.floats(0.0, 1e-2))
def test_the_switching_function_is_odd_bounded_and_sgn_outside_its_layer(sigma, layer):
    value = switching_function(sigma, layer)
    assert value == -switching_function(-sigma, layer)
    assert abs(value) <= 1.0
    if abs(sigma) >= layer:
        assert value == (math.copysign(1.0, sigma) if sigma else 0.0)


def test_with_feedforward_the_surface_is_that_of_the_error():
    r, rate, acceleration = 3e-6, 4e-5, 2e-4
    servo = make_law(ControlParameters(law="smc", smc=SlidingDesign(velocity_bandwidth=1e5)), STAGE)
    servo.reset(r - rate * T)
    answer = servo.step(r, r, rate, acceleration)
    # On the reference and moving with it σ is zero, but for the velocity filter's last thousandth.
    assert abs(answer.sliding_variable) < 1e-3 * rate
    a, b = state_matrices(STAGE)
    assert answer.current == pytest.approx((acceleration - a[2, 1] * r) / b[2], rel=1e-3)


@pytest.mark.parametrize(
    ("stage", "limit"), [(limited(0.05), 0.05), (NARROW_DRIVE, NARROW_DRIVE.drive.largest_current)]
)
def test_at_the_limit_the_integral_goes_on_where_that_takes_the_current_off_it(stage, limit):
    gains = sliding_mode.gains(DESIGN, stage, switching=False, feedforward=False)
    for sign in (1.0, -1.0):
        wound = sliding_mode.State(-1e-4 * sign, 0.0, 0.0)
        for error, held in ((1e-6, False), (-1e-6, True)):
            after, answer = sliding_mode.step(gains, wound, sign * error, 0.0, 0.0, 0.0, 0.0)
            assert answer.current == sign * limit
            assert after.integral == pytest.approx(wound.integral + (0.0 if held else sign * error * T), rel=1e-12)


def stage_with(travel):
    return from_mapping(StageParameters, {"guide.travel": travel, "friction.static": 0.645})


NARROW = stage_with(travel=25e-6)


def test_the_poles_are_those_of_the_paper():
    poles = sorted(closed_loop_poles(DESIGN, NARROW), key=lambda pole: (pole.real, pole.imag))
    on_surface = DESIGN.omega_n * (-DESIGN.zeta + 1j * math.sqrt(1.0 - DESIGN.zeta**2))
    assert poles == pytest.approx([on_surface.conjugate(), on_surface, -100.0], abs=1e-6)
    assert on_surface == pytest.approx(-175.9 + 131.9j, abs=0.1)


GAP = STAGE.actuator.air_gap


@pytest.mark.parametrize(
    "stage",
    [
        # Where each part of the demand is more than a hundredth of it.
        stage_with(travel=0.3 * GAP),
        *(from_mapping(StageParameters, {"platform.stiffness": stiffness}) for stiffness in (1e4, 1e5, 3e5)),
    ],
    ids=["far", "soft flexure", "flexure", "flexure stiffer than the magnets"],
)
def test_the_reaching_bound_is_that_of_equation_11_with_a_flexure_too(stage):
    """By the surface's own matrices, for the current of either sign that holds the platform at its travel."""
    actuator, mass, y = stage.actuator, stage.platform.mass, stage.guide.travel
    a, b = state_matrices(stage)
    motion, friction = abs(a[2, 1] * y), stage.friction.static / mass
    demands = []
    for sign in (1.0, -1.0):
        hold = sign * (motion + friction) / b[2]
        m_y, m_i = stiffness_errors(y / actuator.air_gap, hold / actuator.bias_current)
        magnets = m_y * actuator.position_stiffness / mass * y
        demands.append((abs(m_i) * motion + magnets + friction + DESIGN.gamma) / (1.0 - abs(m_i)))
    assert reaching_bound(DESIGN, stage) == pytest.approx(max(demands), rel=1e-12)
    assert reaching_bound(DESIGN, stage_with(travel=0.6 * GAP)) == math.inf  # no ρ for |m_i| = 1


def test_a_rho_below_the_reaching_bound_is_refused_unless_it_is_wanted():
    with pytest.raises(ParameterError, match=r"control\.smc\.rho.*0\.2.*\(11\).*> 0\.31"):
        ControlParameters(law="smc", smc=SlidingDesign(rho=0.2)).check(NARROW)
    ControlParameters(law="smc", smc=SlidingDesign(rho=0.2, enforce_reaching=False)).check(NARROW)
    ControlParameters(law="linear", smc=SlidingDesign(rho=0.2)).check(NARROW)
