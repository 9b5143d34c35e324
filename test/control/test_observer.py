import math

import numpy as np
import pytest

from straightcomp_ros.control.observer import Estimate, corrected, interval, observer_gains, predicted
from straightcomp_ros.model.actuator import ActuatorParameters, control_current
from straightcomp_ros.model.friction import LuGreParameters
from straightcomp_ros.model.plant import PlantParameters, PlantState, advance, as_array

ACTUATOR = ActuatorParameters().constants()
RATE = 2 * math.pi * 500.0
PERIOD = 5e-4
FREE = PlantParameters(
    friction=LuGreParameters(1e-12, 1e-12, 1.0, bristle_stiffness=1e-3, bristle_damping=0.0, viscous=0.0)
)


def test_the_gains_place_all_three_poles():
    bandwidth = 150.0
    gains = np.array(observer_gains(bandwidth, 1.0, PERIOD))
    step = np.array([[1, PERIOD, PERIOD**2 / 2], [0, 1, PERIOD], [0, 0, 1]])
    error = step @ (np.eye(3) - np.outer(gains, [1, 0, 0]))
    assert np.linalg.eigvals(error) == pytest.approx(math.exp(-2 * math.pi * bandwidth * PERIOD), abs=1e-4)


def test_the_prediction_is_the_plant_without_friction():
    estimate = Estimate(2e-4, -1e-3, 0.0, 0.02)
    state = np.array(PlantState(y=2e-4, velocity=-1e-3, control=0.02, bias=1.0))
    advance(as_array(FREE.constants()), state, 1.0, 0.05, 500_000)
    ahead = predicted(ACTUATOR, FREE.platform.mass, interval(RATE, PERIOD), estimate, 0.05)
    assert ahead.current == pytest.approx(state[3], rel=1e-9)
    assert ahead.velocity - estimate.velocity == pytest.approx(state[1] - estimate.velocity, rel=0.02)
    # The current rises within the period, the prediction takes its mean: a fourteenth of a count.
    assert ahead.y == pytest.approx(state[0], abs=1e-8)


def test_predicting_for_no_time_changes_nothing():
    estimate = Estimate(1e-6, 1e-5, 0.1, 0.01)
    assert predicted(ACTUATOR, 3.0, interval(RATE, 0.0), estimate, 0.5) == pytest.approx(estimate, rel=1e-12)


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


@pytest.mark.parametrize("y", [1e-2, -1e-2, 1e3])
def test_an_estimate_outside_the_air_gap_stays_finite(y):
    ahead = predicted(ACTUATOR, 3.0, interval(RATE, PERIOD), Estimate(y, 0.0, 0.0, 0.0), 0.1)
    assert all(math.isfinite(value) for value in ahead)


@pytest.mark.parametrize("y", [2e-4, 1.4e-3, 1.6e-3, 1.0])
def test_mirroring_the_platform_mirrors_the_prediction(y):
    over = interval(RATE, PERIOD)
    ahead = predicted(ACTUATOR, 3.0, over, Estimate(y, 2e-3, 0.3, 0.02), 0.05)
    mirrored = predicted(ACTUATOR, 3.0, over, Estimate(-y, -2e-3, -0.3, -0.02), -0.05)
    assert mirrored == pytest.approx([-value for value in ahead], rel=1e-12)


def test_the_magnets_pull_grows_up_to_the_edge_of_the_gap_and_stays_so_beyond():
    gap = ACTUATOR.air_gap
    pulls = [
        predicted(ACTUATOR, 3.0, interval(RATE, PERIOD), Estimate(part * gap, 0.0, 0.0, 0.0), 0.0).velocity
        for part in (0.0, 0.5, 0.9, 0.94, 0.95, 0.96, 2.0)
    ]
    assert pulls[0] == pytest.approx(0.0, abs=1e-12)
    assert pulls[0] < pulls[1] < pulls[2] < pulls[3] < pulls[4]
    assert pulls[4] == pulls[5] == pulls[6]


def test_the_force_is_that_of_the_place_reached_halfway():
    over = interval(RATE, PERIOD)
    moving = predicted(ACTUATOR, 3.0, over, Estimate(1e-4, 0.4, 0.0, 0.0), 0.0)
    at_halfway = predicted(ACTUATOR, 3.0, over, Estimate(1e-4 + 0.5 * PERIOD * 0.4, 0.0, 0.0, 0.0), 0.0)
    assert moving.velocity - 0.4 == pytest.approx(at_halfway.velocity, rel=1e-9)


def test_under_a_known_disturbance_alone_the_prediction_is_the_parabola_of_free_fall():
    # Without bias current the magnets do not pull.
    ahead = predicted(
        ACTUATOR._replace(bias_current=0.0), 3.0, interval(RATE, 0.01), Estimate(0.0, 2.0, 10.0, 0.0), 0.0
    )
    assert ahead.y == pytest.approx(2.0 * 0.01 + 0.5 * 10.0 * 0.01**2, rel=1e-12)
    assert ahead.velocity == pytest.approx(2.0 + 10.0 * 0.01, rel=1e-12)


def test_the_mean_of_an_interval_is_the_integral_of_the_coils_decay():
    for duration in (1e-6, PERIOD, 0.02):
        times = np.linspace(0.0, duration, 20_001)
        decay = np.exp(-RATE * times)
        assert interval(RATE, duration).mean == pytest.approx(np.trapezoid(decay, times) / duration, rel=1e-5)
        assert interval(RATE, duration).left == pytest.approx(decay[-1], rel=1e-12)
    assert interval(RATE, 0.0) == (0.0, 1.0, 1.0)
