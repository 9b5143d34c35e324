"""The magnets: equations (2) to (4), and the inverse."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.actuator import (
    UNIT_GAIN_ERROR_LIMIT,
    ActuatorParameters,
    control_current,
    magnetic_force,
    stiffness_errors,
)

PARAMETERS = ActuatorParameters()
ACTUATOR = PARAMETERS.constants()
GAP, BIAS = PARAMETERS.air_gap, PARAMETERS.bias_current
K_I, K_Y = PARAMETERS.current_stiffness, PARAMETERS.position_stiffness


def force(y, i):
    return magnetic_force(ACTUATOR, y, BIAS, i)


def test_small_signal_stiffnesses_are_the_slopes_of_the_force_at_the_centre():
    h = 1e-6
    assert (force(0.0, h) - force(0.0, -h)) / (2 * h) == pytest.approx(K_I, rel=1e-9)
    assert (force(h, 0.0) - force(-h, 0.0)) / (2 * h) == pytest.approx(K_Y, rel=1e-5)


def test_the_consistent_plant_has_the_stiffnesses_of_the_design_document():
    assert pytest.approx(44.7, abs=0.05) == K_I
    assert pytest.approx(29.8e3, abs=50) == K_Y
    assert math.sqrt(K_Y / 3.0) == pytest.approx(100, abs=1)


@given(st.floats(-0.95, 0.95), st.floats(-1.0, 1.0))
def test_the_force_is_its_closed_form_in_a_and_b(a, b):
    closed = K_I * BIAS * (a + b) * (1 + a * b) / (1 - a * a) ** 2
    assert force(a * GAP, b * BIAS) == pytest.approx(closed, rel=1e-9, abs=1e-9)


@given(st.floats(-0.95, 0.95), st.floats(-1.0, 1.0))
def test_stiffness_errors_make_equation_3_exact(a, b):
    m_y, m_i = stiffness_errors(a, b)
    # (4) splits the cross terms so that K_y y + K_i i_c is (2) again.
    by_3 = (1 + m_y) * K_Y * a * GAP + (1 + m_i) * K_I * b * BIAS
    assert by_3 == pytest.approx(force(a * GAP, b * BIAS), rel=1e-9, abs=1e-9)
    assert 1 + m_i >= 0.0


def test_gain_error_reaches_one_exactly_at_the_limit_of_the_position():
    b = np.linspace(-1, 1, 401)
    worst = lambda a: max(abs(stiffness_errors(a, i)[1]) for i in b)  # noqa: E731
    assert pytest.approx(0.3660, abs=5e-5) == UNIT_GAIN_ERROR_LIMIT
    assert worst(UNIT_GAIN_ERROR_LIMIT) == pytest.approx(1.0, abs=1e-12)
    assert worst(UNIT_GAIN_ERROR_LIMIT - 1e-3) < 1.0 < worst(UNIT_GAIN_ERROR_LIMIT + 1e-3)


@given(st.floats(-0.95, 0.95), st.floats(-1.0, 1.0))
def test_the_inverse_gives_back_the_current(a, b):
    y, i = a * GAP, b * BIAS
    assert control_current(ACTUATOR, y, force(y, i)) == pytest.approx(i, abs=1e-9)


@given(st.floats(-30.0, 30.0))
def test_the_inverse_has_no_cancellation_at_the_centre(wanted):
    for y in (0.0, 1e-12, 1e-9, -1e-9):
        assert force(y, control_current(ACTUATOR, y, wanted)) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_beyond_the_reachable_force_the_inverse_gives_the_strongest_current():
    y = 0.9 * GAP
    strongest = control_current(ACTUATOR, y, -1e9)
    assert force(y, strongest) <= min(force(y, strongest + d) for d in (-0.01, 0.01))
