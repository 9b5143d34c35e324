"""The observer: its poles, its prediction, what the measured current corrects, and the loop's nominal model."""

import math

import numpy as np
import pytest
from scipy.integrate import trapezoid

from straightcomp_ros.control.observer import (
    Estimate,
    corrected,
    current_for,
    interval,
    limited,
    moment_of_action,
    nominal_loop,
    observer_gains,
    predicted,
    with_measured_current,
)
from straightcomp_ros.model.actuator import ActuatorParameters, control_current, magnetic_force
from straightcomp_ros.model.friction import LuGreParameters
from straightcomp_ros.model.plant import PlantParameters, advance, plant_state
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters

ACTUATOR = ActuatorParameters().constants()
RATE = 2 * math.pi * 500.0
PERIOD = 5e-4
FREE = PlantParameters(
    friction=LuGreParameters(1e-12, 1e-12, 1.0, bristle_stiffness=1e-3, bristle_damping=0.0, viscous=0.0)
)


def test_the_prediction_is_the_plant_without_friction():
    estimate = Estimate(2e-4, -1e-3, 0.0, 0.02)
    state = plant_state(y=2e-4, velocity=-1e-3, control=0.02, bias=1.0)
    advance(FREE.constants(), state, 1.0, 0.05, 500_000)
    ahead = predicted(ACTUATOR, FREE.platform.mass, interval(RATE, PERIOD), estimate, 0.05)
    assert ahead.current == pytest.approx(state[3], rel=1e-9)
    assert ahead.velocity - estimate.velocity == pytest.approx(state[1] - estimate.velocity, rel=0.02)
    # The current rises within the period, the prediction takes its mean: a fourteenth of a count.
    assert ahead.y == pytest.approx(state[0], abs=1e-8)


def test_a_constant_disturbance_is_found_exactly():
    # The platform is held at y by a current that balances the magnets and a disturbance of 0.2 m/s².
    y, disturbance = 5e-6, 0.2
    current = control_current(ACTUATOR, y, -3.0 * disturbance)
    estimate = Estimate(0.0, 0.0, 0.0, current)
    gains = observer_gains(200.0, 1.0, PERIOD)
    for _ in range(400):
        estimate = predicted(ACTUATOR, 3.0, interval(RATE, PERIOD), corrected(gains, estimate, y), current)
    assert estimate.y == pytest.approx(y, abs=1e-12)
    assert estimate.disturbance == pytest.approx(disturbance, rel=1e-6)


def test_the_magnets_pull_is_odd_and_grows_up_to_the_edge_of_the_gap_and_stays_so_beyond():
    def pull(part, sign=1.0):
        estimate = Estimate(sign * part * ACTUATOR.air_gap, 2e-3 * sign, 0.3 * sign, 0.02 * sign)
        return predicted(ACTUATOR, 3.0, interval(RATE, PERIOD), estimate, 0.05 * sign)

    speeds = [pull(part).velocity for part in (0.0, 0.5, 0.9, 0.94, 0.95, 0.96, 2.0)]
    assert speeds[:5] == sorted(set(speeds)) and speeds[4] == pytest.approx(speeds[5]) == pytest.approx(speeds[6])
    for part in (0.13, 0.95, 600.0):
        assert pull(part, -1.0) == pytest.approx([-value for value in pull(part)], rel=1e-12)


def test_the_force_is_that_of_the_place_reached_halfway():
    over = interval(RATE, PERIOD)
    moving = predicted(ACTUATOR, 3.0, over, Estimate(1e-4, 0.4, 0.0, 0.0), 0.0)
    at_halfway = predicted(ACTUATOR, 3.0, over, Estimate(1e-4 + 0.5 * PERIOD * 0.4, 0.0, 0.0, 0.0), 0.0)
    assert moving.velocity - 0.4 == pytest.approx(at_halfway.velocity, rel=1e-9)


def test_the_mean_of_an_interval_is_the_integral_of_the_coils_decay():
    for duration in (1e-6, PERIOD, 0.02):
        times = np.linspace(0.0, duration, 20_001)
        decay = np.exp(-RATE * times)
        mean = trapezoid(decay, times) / duration
        assert interval(RATE, duration) == pytest.approx((duration, decay[-1], mean), rel=1e-5)
    assert interval(RATE, 0.0) == (0.0, 1.0, 1.0)


def nominal(delay_samples=0.5):
    return nominal_loop(StageParameters(), delay_samples=delay_samples)


@pytest.mark.parametrize("delay", [0.0, 0.25, 0.9, 1.0])
def test_a_period_is_divided_at_the_delay_and_a_step_of_current_counts_by_its_mean_over_its_end(delay):
    found, acting = nominal(delay), (1.0 - delay) * PERIOD
    assert (found.period, found.delay, found.mass, found.current_limit) == (PERIOD, delay * PERIOD, 3.0, 0.9)
    weak = from_mapping(StageParameters, {"drive.gain": 0.01})
    assert nominal_loop(weak, delay_samples=delay).current_limit == weak.drive.largest_current
    assert (found.before_action, found.after_action) == (interval(RATE, delay * PERIOD), interval(RATE, acting))
    slope = magnetic_force(ACTUATOR, 0.0, ACTUATOR.bias_current, 1e-6) / 1e-6 / 3.0
    assert found.current_gain == pytest.approx(slope, rel=1e-6)
    risen = 1.0 - np.exp(-RATE * np.linspace(0.0, acting, 20_001))
    share = trapezoid(risen, dx=acting / 20_000) / PERIOD / risen[-1] if acting else 0.0
    assert found.current_share == pytest.approx(share, rel=1e-6)


def test_a_larger_current_than_predicted_has_made_the_platform_faster_by_its_share():
    g, prior = nominal(), Estimate(1e-6, 2e-3, 0.3, 0.05)
    gained = 0.02 * g.current_share * PERIOD * g.current_gain
    expected = (1e-6 + 0.5 * PERIOD * gained, 2e-3 + gained, 0.3, 0.07)
    assert gained > 0.0 and with_measured_current(g, prior, 0.07) == pytest.approx(expected, rel=1e-9)
    assert with_measured_current(g, prior, math.nan) == prior


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0])
def test_on_the_reference_at_the_moment_of_action_there_is_no_error(delay):
    # A free platform that follows a parabola: the observer's estimate is exact, and its disturbance drives it.
    g = nominal(delay)._replace(actuator=ACTUATOR._replace(bias_current=0.0))
    y, v, a = 1e-6, 2e-3, 0.4
    now = Estimate(y, v, a, 0.0)
    action, error, rate_error = moment_of_action(g, now, 0.0, y, v, a)
    assert action.y == pytest.approx(y + v * g.delay + 0.5 * a * g.delay**2, rel=1e-9)
    assert error == pytest.approx(0.0, abs=1e-18) and rate_error == pytest.approx(0.0, abs=1e-15)
    # Errors are counted y − r.
    _, error, rate_error = moment_of_action(g, now, 0.0, y - 3e-7, v - 4e-5, a)
    assert error == pytest.approx(3e-7 + 4e-5 * g.delay) and rate_error == pytest.approx(4e-5)


@pytest.mark.parametrize("y", [0.0, 1e-5, -2e-4])
def test_the_current_for_an_acceleration_gives_it_by_the_magnets_law_up_to_the_edge_of_the_gap(y):
    g, gap = nominal(), ACTUATOR.air_gap
    for acceleration in (-0.5, 0.0, 0.5):
        force = magnetic_force(ACTUATOR, y, ACTUATOR.bias_current, current_for(g, y, acceleration))
        assert force / g.mass == pytest.approx(acceleration, abs=1e-9)
    assert current_for(g, 2.0 * gap, 0.0) == current_for(g, 50.0 * gap, 0.0) == -current_for(g, -2.0 * gap, 0.0) != 0.0
    for current in (-2.0, -0.9, -0.3, 0.0, 0.3, 0.9, 2.0):
        assert limited(0.9, current) == np.clip(current, -0.9, 0.9)
