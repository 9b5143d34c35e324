import math

import numpy as np
import pytest

from straightcomp_ros.control.observer import Estimate, corrected, interval, observer_gains, predicted
from straightcomp_ros.model.actuator import ActuatorParameters, control_current
from straightcomp_ros.model.friction import FrictionParameters
from straightcomp_ros.model.plant import PlantParameters, PlantState, advance, as_array

ACTUATOR = ActuatorParameters().constants()
RATE = 2 * math.pi * 500.0
PERIOD = 5e-4
FREE = PlantParameters(
    friction=FrictionParameters(1e-12, 1e-12, 1.0, bristle_stiffness=1e-3, bristle_damping=0.0, viscous=0.0)
)


def test_the_gains_place_all_three_poles():
    bandwidth = 150.0
    gains = np.array(observer_gains(bandwidth, PERIOD))
    step = np.array([[1, PERIOD, PERIOD**2 / 2], [0, 1, PERIOD], [0, 0, 1]])
    error = step @ (np.eye(3) - np.outer(gains, [1, 0, 0]))
    assert np.linalg.eigvals(error) == pytest.approx(math.exp(-2 * math.pi * bandwidth * PERIOD), abs=1e-4)


def test_the_prediction_is_the_plant_without_friction():
    estimate = Estimate(2e-4, -1e-3, 0.0, 0.02)
    state = np.array(PlantState(y=2e-4, velocity=-1e-3, control=0.02, bias=1.0))
    advance(as_array(FREE.constants()), state, 1.0, 0.05, 500_000)
    ahead = predicted(ACTUATOR, FREE.mass, interval(RATE, PERIOD), estimate, 0.05)
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
    gains = observer_gains(200.0, PERIOD)
    for _ in range(400):
        estimate = predicted(ACTUATOR, 3.0, interval(RATE, PERIOD), corrected(gains, estimate, y), current)
    assert estimate.y == pytest.approx(y, abs=1e-12)
    assert estimate.disturbance == pytest.approx(disturbance, rel=1e-6)


@pytest.mark.parametrize("y", [1e-2, -1e-2, 1e3])
def test_an_estimate_outside_the_air_gap_stays_finite(y):
    ahead = predicted(ACTUATOR, 3.0, interval(RATE, PERIOD), Estimate(y, 0.0, 0.0, 0.0), 0.1)
    assert all(math.isfinite(value) for value in ahead)
