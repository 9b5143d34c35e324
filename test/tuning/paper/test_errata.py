"""The errata of equations (6) and (10), both sides computed apart; closed forms of the sliding motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from straightcomp_ros.control.sliding_mode import SlidingDesign, reaching_demand, state_matrices
from straightcomp_ros.model.actuator import (
    ActuatorParameters,
    control_current,
    magnetic_force,
    stiffness_errors,
)
from straightcomp_ros.model.friction import LuGreParameters
from straightcomp_ros.model.plant import advance, plant_state
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.paper import recovery
from straightcomp_ros.tuning.paper.friction import estimate_friction, stick_phases
from straightcomp_ros.tuning.paper.gain_error import FAR
from straightcomp_ros.tuning.paper.machine import AMPLITUDE, OMEGA, evaluated, follow_sine, fundamental
from straightcomp_ros.tuning.paper.surface import (
    following_error_gain,
    free_motion,
    lag,
    rate_implied,
    reaching_time,
    sliding_variable_over,
)

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


positive = st.floats(0.1, 100.0)


@given(positive, positive, st.floats(1e-3, 1.0))
def test_the_sliding_variable_obeys_its_differential_equation_until_it_is_zero_at_the_reaching_time(phi, rho, sigma_0):
    end = reaching_time(phi, rho, sigma_0)
    before, after = sliding_variable_over(np.array([0.999 * end, 1.001 * end]), phi, rho, sigma_0)
    assert before > 0.0 and after == 0.0
    time = np.linspace(0.0, 0.9 * end, 50)
    answer = solve_ivp(lambda t, s: -phi * s - rho, time[[0, -1]], [sigma_0], t_eval=time, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sliding_variable_over(time, phi, rho, sigma_0), answer.y[0], rtol=1e-6, atol=1e-9)


def test_without_a_rate_the_switching_alone_reaches_the_surface_and_no_rate_does_so_later():
    assert [reaching_time(rate, 2.0, -0.5) for rate in (0.0, 1e-9)] == pytest.approx([0.25, 0.25])
    assert math.isnan(rate_implied(0.26, 1.0, 0.1))


@given(st.floats(0.5, 50.0), st.floats(1e-3, 1.0), st.floats(1e-2, 1.0))
def test_the_rate_implied_by_a_reaching_time_gives_that_time(phi, rho, sigma_0):
    time = reaching_time(phi, rho, sigma_0)
    assert rate_implied(time, rho, sigma_0) == pytest.approx(phi, rel=1e-6)


def test_free_motion_solves_equation_12():
    start, time = [3e-4, -0.02], np.linspace(0.0, 0.05, 100)
    matrix = np.array([[0.0, 1.0], [-(DESIGN.omega_n**2), -2.0 * DESIGN.zeta * DESIGN.omega_n]])
    answer = solve_ivp(lambda t, s: matrix @ s, time[[0, -1]], start, t_eval=time, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(free_motion(time, DESIGN, *start), answer.y[0], atol=1e-11)


def test_the_reaching_condition_asks_for_nothing_without_friction_and_cannot_be_met_beyond_the_gain_error_limit():
    frictionless = replace(STAGE, friction=LuGreParameters(coulomb=0.0, static=0.0))
    assert reaching_demand(DESIGN, frictionless, 0.0, 0.5) == pytest.approx(DESIGN.gamma)
    assert math.isinf(reaching_demand(DESIGN, STAGE, 0.6 * ACTUATOR.air_gap, ACTUATOR.bias_current))


def test_without_friction_the_sine_is_followed_with_the_lag_of_equation_12_and_with_it_the_platform_sticks(machine):
    ideal = machine.idealised().with_law("linear").without_friction()
    response, design = evaluated(follow_sine(ideal)), ideal.control.smc
    amplitude = fundamental(response.time, response.reference - response.y)
    for expected in (following_error_gain(design, OMEGA) * AMPLITUDE, lag(design) * OMEGA * AMPLITUDE):
        assert amplitude == pytest.approx(expected, rel=0.01)
    run = evaluated(follow_sine(machine.with_law("linear")))
    sticks = stick_phases(run, machine.plant.friction.coulomb)
    # Once at each reversal.
    assert len(sticks) == 4 and np.abs(run.reference[sticks[:, 0]]).min() > 0.95 * AMPLITUDE


@pytest.fixture(scope="module")
def data(machine):
    return recovery.regions(machine, points=21)


@pytest.mark.parametrize("a", [-0.7, 0.0, 0.4])
def test_the_physical_limit_is_what_full_current_does_in_a_machine_without_lag_and_friction(machine, a):
    """The closed form is an integral of (2); the simulation knows nothing of it."""
    drive = replace(machine.plant.drive, bandwidth=1e6)
    ideal, y = replace(machine, plant=replace(machine.plant, drive=drive)).without_friction(), a * machine.gap
    constants = ideal.plant.constants()
    for factor in (0.99, 1.01):
        velocity = factor * recovery.fastest_outward(ideal, y)
        state = plant_state(y=y, velocity=velocity, bias=ideal.bias)
        while state[1] > 0.0 and state[0] < ideal.stop:
            advance(constants, state, ideal.bias, -ideal.bias, 10_000)
        assert (state[0] < ideal.stop) == recovery.possible(ideal, y, velocity) == (factor < 1.0)


@pytest.mark.parametrize("law", recovery.SHOWN)
def test_every_law_recovers_from_fig_4_and_not_from_beyond_the_stop_nor_from_where_no_current_could(data, law):
    one, back = data.machine.with_law(law), data.back(law)
    assert recovery.recovers(one, FAR * one.gap) and not recovery.recovers(one, 1.05 * one.stop)
    assert 0 < back.sum() < data.possible.sum() and not (back & ~data.possible).any()


def test_what_is_mirrored_is_what_is_computed(data):
    row, column = 7, 12
    y, velocity = data.positions[column], data.velocities[row]
    computed = recovery.peak(data.machine.with_law("smc_observer"), y, velocity)
    assert velocity < 0.0 and np.isfinite(computed)
    assert data.peaks["smc_observer"][row, column] == pytest.approx(computed, abs=1e-6)


def test_a_known_friction_is_found_again_through_equations_1_and_2():
    rate, mass, magnets, inner = 2000.0, 3.0, ActuatorParameters(), slice(100, -100)
    t = np.arange(4000) / rate
    y = AMPLITUDE * np.sin(OMEGA * t)
    friction = 0.6 * np.tanh(y / 20e-6)
    force = friction - mass * OMEGA**2 * y
    current = np.array([control_current(magnets.constants(), *pair) for pair in zip(y, force, strict=True)])
    velocity, found = estimate_friction(y, current, rate=rate, mass=mass, actuator=magnets)
    np.testing.assert_allclose(found[inner], friction[inner], atol=1e-4)
    np.testing.assert_allclose(velocity[inner], AMPLITUDE * OMEGA * np.cos(OMEGA * t)[inner], atol=1e-8)
