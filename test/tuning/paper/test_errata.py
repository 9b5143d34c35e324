"""The errata of equations (6) and (10), shown on numbers: both sides computed apart from each other."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.control.sliding_mode import SlidingDesign, state_matrices
from straightcomp_ros.model.actuator import magnetic_force, stiffness_errors
from straightcomp_ros.stage.description import StageParameters

DESIGN, STAGE = SlidingDesign(), StageParameters()
ACTUATOR, MASS = STAGE.actuator, STAGE.platform.mass
A, B = state_matrices(STAGE)
B_R = np.array([-1.0, 0.0, 0.0])
S = np.array([DESIGN.omega_n**2, 2.0 * DESIGN.zeta * DESIGN.omega_n, 1.0])
RHO = 1.0

positions = st.floats(-0.3, 0.3)
currents = st.floats(-0.9, 0.9)
forces = st.floats(-1.0, 1.0)
integrals = st.floats(-1e-7, 1e-7)
references = st.floats(-25e-6, 25e-6)


def state_rate(x: np.ndarray, r: float, current: float, force: float) -> np.ndarray:
    """ẋ of the plant by (1) and (2), without any linearisation."""
    acceleration = (magnetic_force(ACTUATOR.constants(), x[1], ACTUATOR.bias_current, current) + force) / MASS
    return np.array([x[1] - r, x[2], acceleration])


def matched_disturbance(x: np.ndarray, current: float, force: float, *, with_current: bool) -> float:
    """η in the current's unit (K_a = 1): stiffness error of the position, disturbing force, and m_i u if asked for."""
    m_y, m_i = stiffness_errors(x[1] / ACTUATOR.air_gap, current / ACTUATOR.bias_current)
    rest = m_y * ACTUATOR.position_stiffness * x[1] + force
    return rest / ACTUATOR.current_stiffness + (m_i * current if with_current else 0.0)


@given(a=positions, current=currents, force=forces, integral=integrals, r=references, velocity=st.floats(-1e-3, 1e-3))
def test_equation_6_counts_the_error_of_the_current_stiffness_once(a, current, force, integral, r, velocity):
    x = np.array([integral, a * ACTUATOR.air_gap, velocity])
    _, m_i = stiffness_errors(a, current / ACTUATOR.bias_current)
    eta = matched_disturbance(x, current, force, with_current=True)
    once = A @ x + B * current + B_R * r + B * eta
    np.testing.assert_allclose(once, state_rate(x, r, current, force), rtol=1e-9, atol=1e-9)
    twice = once + B * m_i * current
    wrong_by = float(B[2]) * m_i * current
    assert (twice - state_rate(x, r, current, force))[2] == pytest.approx(wrong_by, rel=1e-6, abs=1e-6)


@given(a=positions, force=forces, integral=integrals, r=references, velocity=st.floats(-1e-3, 1e-3))
def test_the_disturbance_enters_equation_10_with_a_plus(a, force, integral, r, velocity):
    x = np.array([integral, a * ACTUATOR.air_gap, velocity])
    sigma = float(S @ x)
    sign = math.copysign(1.0, sigma)
    drift = float(S @ A @ x + S @ B_R * r)
    current = -(drift + DESIGN.phi * sigma + RHO * sign) / float(S @ B)
    if abs(current) > ACTUATOR.bias_current:
        return  # (4) speaks of |i_c| ≤ I0 only
    _, m_i = stiffness_errors(a, current / ACTUATOR.bias_current)
    sb_eta = float(S @ B) * matched_disturbance(x, current, force, with_current=False)
    common = -(1 + m_i) * DESIGN.phi * sigma - m_i * drift - (1 + m_i) * RHO * sign
    truth = float(S @ state_rate(x, r, current, force))
    assert common + sb_eta == pytest.approx(truth, rel=1e-9, abs=1e-9)
    assert common - sb_eta == pytest.approx(truth - 2.0 * sb_eta, rel=1e-9, abs=1e-9)


def test_the_printed_sign_is_wrong_wherever_there_is_a_disturbance():
    x = np.zeros(3)
    with_plus = float(S @ B) * matched_disturbance(x, 0.0, 0.5, with_current=False)
    assert float(S @ state_rate(x, 0.0, 0.0, 0.5)) == pytest.approx(with_plus)
    assert abs(2.0 * with_plus) > 0.3
