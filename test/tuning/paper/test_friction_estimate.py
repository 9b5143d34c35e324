import numpy as np
import pytest

from straightcomp_ros.model.actuator import ActuatorParameters, control_current
from straightcomp_ros.tuning.paper.friction import WINDOW, estimate_friction, friction_curve, hysteresis, smoothed

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
    estimate = estimate_friction(y, current, rate=RATE, mass=MASS, actuator=MAGNETS)
    np.testing.assert_allclose(estimate.friction[inner], friction[inner], atol=1e-4)
    np.testing.assert_allclose(estimate.velocity[inner], amplitude * omega * np.cos(omega * t)[inner], atol=1e-8)


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
    data = friction_curve(machine)
    deviation = data.estimate.friction - data.friction
    assert np.sqrt(np.mean(deviation**2)) < 0.01
    assert np.abs(deviation).max() < 0.1
    # Friction holds on while the velocity has already turned: the loop is open by nearly twice Coulomb's.
    coulomb = machine.plant.friction.coulomb
    assert coulomb < data.width < 2.5 * coulomb
