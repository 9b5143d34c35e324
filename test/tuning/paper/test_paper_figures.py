"""The figures of the paper: what the machine does in each, and where each law brings the platform back from."""

import re
from dataclasses import replace

import numpy as np
import pytest

from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.model.actuator import UNIT_GAIN_ERROR_LIMIT, ActuatorParameters, control_current
from straightcomp_ros.tuning.paper import gain_error, recovery
from straightcomp_ros.tuning.paper.friction import (
    WINDOW,
    estimate_friction,
    friction_curve,
    hysteresis,
    smoothed,
    stick_phases,
)
from straightcomp_ros.tuning.paper.gain_error import FAR
from straightcomp_ros.tuning.paper.machine import AMPLITUDE, OMEGA, evaluated, follow_sine, fundamental
from straightcomp_ros.tuning.paper.surface import (
    NEAR,
    following_error_gain,
    free_motion,
    lag,
    reaching_time,
    sliding_release,
    sliding_variable_at_rest,
)


def test_the_gain_error_limit_found_is_the_closed_form_and_beyond_it_the_error_exceeds_one():
    limit, largest = gain_error.gain_error_limit(), gain_error.largest_gain_error
    assert limit == pytest.approx(UNIT_GAIN_ERROR_LIMIT, abs=1e-9) == pytest.approx(0.3660, abs=5e-5)
    assert largest(limit - 1e-3) < 1.0 < largest(limit + 1e-3)


def test_released_far_out_the_unclamped_law_hits_the_stop_and_the_clamped_one_brings_the_platform_back(machine):
    free = gain_error.unclamped(machine)
    unclamped, clamped = (gain_error.released(one, FAR) for one in (free, free.with_limit(machine.bias)))
    assert unclamped.y[-1] == machine.stop and np.abs(unclamped.y).min() >= FAR * machine.gap
    assert abs(clamped.y[-1]) < 1e-2 * machine.gap and np.abs(clamped.command).max() <= machine.bias


def test_the_unclamped_law_loses_the_platform_within_the_gain_error_limit(machine):
    """|m_i| ≤ 1 holds for |i_c| ≤ I0 only, and the unclamped law asks for more."""
    free = gain_error.unclamped(machine)
    returns_from = gain_error.largest_release(free)
    assert NEAR < returns_from < UNIT_GAIN_ERROR_LIMIT
    assert not gain_error.returns(free, returns_from + 0.01)


def test_the_surface_is_reached_in_the_time_of_the_closed_form_and_the_motion_on_it_is_equation_12(machine):
    design, (response, reached) = machine.control.smc, sliding_release(machine)
    sigma_0 = sliding_variable_at_rest(design, response.y[0])
    # Within a tenth: m_i and friction, which the closed form leaves out, pull both ways.
    assert response.time[reached] == pytest.approx(reaching_time(design.phi, design.rho, sigma_0), rel=0.1)
    assert np.abs(response.sigma[reached + 1 :]).max() < 0.01 * sigma_0
    time = response.time[reached:] - response.time[reached]
    closed = free_motion(time, design, response.y[reached], response.velocity[reached])
    assert abs(closed[0]) > 10e-6 and np.abs(response.y[reached:] - closed).max() < 1e-6


def test_without_friction_the_sine_is_followed_with_the_lag_of_equation_12(machine):
    ideal = machine.idealised().with_law("linear").without_friction()
    response, design = evaluated(follow_sine(ideal)), ideal.control.smc
    amplitude = fundamental(response.time, response.reference - response.y)
    for expected in (following_error_gain(design, OMEGA) * AMPLITUDE, lag(design) * OMEGA * AMPLITUDE, 1.83e-6):
        assert amplitude == pytest.approx(expected, rel=0.01)


def test_with_friction_the_platform_sticks_once_at_each_reversal(machine):
    run = evaluated(follow_sine(machine.with_law("linear")))
    sticks = stick_phases(run, machine.plant.friction.coulomb)
    assert len(sticks) == 4 and np.abs(run.reference[sticks[:, 0]]).min() > 0.95 * AMPLITUDE


@pytest.fixture(scope="module")
def data(machine):
    return recovery.regions(machine, points=21)


@pytest.mark.parametrize("a", [-0.7, -0.3, 0.0, 0.4, 0.7])
def test_the_physical_limit_is_what_full_current_does_in_a_machine_without_lag_and_friction(machine, a):
    """The closed form is an integral of (2); the simulation knows nothing of it."""
    drive = replace(machine.plant.drive, bandwidth=1e6, delay=0.0)
    plant, stage = replace(machine.plant, drive=drive), replace(machine.stage, rate=100_000, drive=drive)
    ideal, y = replace(machine, plant=plant, stage=stage).without_friction(), a * machine.gap
    slower, faster = (factor * recovery.fastest_outward(ideal, y) for factor in (0.99, 1.01))
    assert recovery.least_peak(ideal, y, slower) < ideal.stop < recovery.least_peak(ideal, y, faster)
    assert recovery.possible(ideal, y, slower) and not recovery.possible(ideal, y, faster)


@pytest.mark.parametrize("law", LAWS)
def test_every_law_recovers_from_the_centre_and_from_fig_4_but_not_from_beyond_the_stop(data, law):
    one = data.machine.with_law(law)
    assert recovery.peak(one, 0.0) < 1e-6
    assert recovery.recovers(one, FAR * one.gap) and not recovery.recovers(one, 1.05 * one.stop)


def test_more_current_recovers_from_further_out(machine):
    one = machine.with_law("smc")
    reached = [recovery.largest_release(one.with_limit(part * one.bias)) for part in (0.4, 0.7, 1.0)]
    assert reached == sorted(reached) and reached[0] < 0.9 * reached[-1] < one.stop


def test_no_law_reaches_beyond_what_the_amplifier_leaves_and_that_not_beyond_physics(data):
    leaves = data.within_stops(data.least_peaks)
    assert 0 < leaves.sum() < data.possible.sum() and not (leaves & ~data.possible).any()
    for law in LAWS:
        back = data.within_stops(data.peaks[law])
        assert back.any() and not (back & ~leaves).any()


def test_what_is_mirrored_is_what_is_computed(data):
    row, column = 7, 12
    y, velocity = data.positions[column], data.velocities[row]
    computed = recovery.peak(data.machine.with_law("smc_observer"), y, velocity)
    assert velocity < 0.0 and np.isfinite(computed)
    assert data.peaks["smc_observer"][row, column] == pytest.approx(computed, abs=1e-6)


RATE, MASS, MAGNETS = 2000.0, 3.0, ActuatorParameters()
inner = slice(100, -100)


def test_the_moving_cubic_leaves_a_cubic_and_its_derivatives_as_they_are():
    t = np.arange(400) / RATE
    y = 1e-6 * (1.0 + 2.0 * t - 3.0 * t**2 + 4.0 * t**3)
    np.testing.assert_allclose(smoothed(y, RATE), y, rtol=1e-9)
    np.testing.assert_allclose(smoothed(y, RATE, 1), 1e-6 * (2.0 - 6.0 * t + 12.0 * t**2), rtol=1e-6)
    np.testing.assert_allclose(smoothed(y, RATE, 2), 1e-6 * (-6.0 + 24.0 * t), rtol=1e-4, atol=1e-10)


def test_a_known_friction_is_found_again_through_equations_1_and_2():
    t = np.arange(4000) / RATE
    omega, amplitude = 2.0 * np.pi * 0.8, 50e-6
    y = amplitude * np.sin(omega * t)
    friction = 0.6 * np.tanh(y / 20e-6)
    force = friction - MASS * omega**2 * y
    current = np.array([control_current(MAGNETS.constants(), *pair) for pair in zip(y, force, strict=True)])
    velocity, found = estimate_friction(y, current, rate=RATE, mass=MASS, actuator=MAGNETS)
    np.testing.assert_allclose(found[inner], friction[inner], atol=1e-4)
    np.testing.assert_allclose(velocity[inner], amplitude * omega * np.cos(omega * t)[inner], atol=1e-8)


def test_the_encoders_quantum_becomes_a_millinewton_of_inertial_force():
    noise = 1e-7 * np.random.default_rng(1).uniform(-0.5, 0.5, 20_000)
    assert MASS * smoothed(noise, RATE, 2)[inner].std() == pytest.approx(1e-3, rel=0.5)
    assert WINDOW == 0.02


def test_a_closed_curve_has_a_width_and_a_single_line_has_none():
    phase = np.linspace(0.0, 2.0 * np.pi, 20_000, endpoint=False)
    velocity = 250e-6 * np.cos(phase)
    rising = np.sin(phase) < 0.0
    assert hysteresis(velocity, np.sign(velocity), rising) < 0.2
    assert hysteresis(velocity, np.where(rising, -0.3, 0.3), rising) == pytest.approx(0.6)


def test_the_estimate_follows_the_simulated_friction_within_a_hundredth_of_a_newton(machine):
    deviation, _, width = friction_curve(machine).claims
    largest = float(re.match(r"largest ([\d.]+) N", deviation.note)[1])
    assert deviation.ours < 0.01 and largest < 0.1
    # Friction holds on while the velocity has already turned: the loop is open by nearly twice Coulomb's.
    coulomb = machine.plant.friction.coulomb
    assert coulomb < width.ours < 2.5 * coulomb
