"""The loop as a law believes it: what is measured puts the prediction right, what is asked for is in reach."""

import math

import pytest

from straightcomp_ros.control.observer import (
    Estimate,
    current_for,
    interval,
    limited,
    moment_of_action,
    next_prior,
    nominal_loop,
    with_measured_current,
)
from straightcomp_ros.model.actuator import magnetic_force
from straightcomp_ros.stage.description import StageParameters

PERIOD = 5e-4
CONSTANTS = StageParameters().actuator.constants()


def believed(delay_samples=0.5):
    return nominal_loop(StageParameters(), delay_samples=delay_samples)


@pytest.mark.parametrize("delay", [0.0, 0.25, 1.0])
def test_the_two_parts_of_a_period_are_divided_at_the_delay(delay):
    rate = 2.0 * math.pi * 500.0
    found = believed(delay)
    assert (found.period, found.delay) == (PERIOD, pytest.approx(delay * PERIOD))
    assert found.before_action == interval(rate, delay * PERIOD)
    assert found.after_action == interval(rate, (1.0 - delay) * PERIOD)
    assert (found.mass, found.current_limit) == (3.0, 0.9)
    slope = (magnetic_force(CONSTANTS, 0.0, CONSTANTS.bias_current, 1e-6)) / 1e-6 / 3.0
    assert found.current_gain == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.5, 0.9])
def test_the_share_of_a_current_step_is_its_mean_over_the_period_beside_its_end(delay):
    rate, acting = 2.0 * math.pi * 500.0, (1.0 - delay) * PERIOD
    steps = 20_000
    risen = [1.0 - math.exp(-rate * acting * (k + 0.5) / steps) for k in range(steps)]
    mean = sum(risen) / steps * acting / PERIOD
    assert believed(delay).current_share == pytest.approx(mean / (1.0 - math.exp(-rate * acting)), rel=1e-6)


def test_a_command_that_acts_at_the_end_of_its_period_has_no_share_in_it():
    assert believed(1.0).current_share == 0.0


def test_a_current_as_predicted_or_not_measured_changes_nothing():
    prior = Estimate(1e-6, 2e-3, 0.3, 0.05)
    assert with_measured_current(believed(), prior, math.nan) == prior
    assert with_measured_current(believed(), prior, 0.05) == pytest.approx(prior, rel=1e-12)


def test_a_larger_current_than_predicted_has_made_the_platform_faster_by_its_share():
    g, prior = believed(), Estimate(1e-6, 2e-3, 0.3, 0.05)
    found = with_measured_current(g, prior, 0.07)
    gained = 0.02 * g.current_share * PERIOD * g.current_gain
    assert gained > 0.0 and found.velocity - prior.velocity == pytest.approx(gained)
    assert found.y - prior.y == pytest.approx(0.5 * PERIOD * gained, rel=1e-4)
    assert (found.disturbance, found.current) == (0.3, 0.07)


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0])
def test_on_the_reference_at_the_moment_of_action_there_is_no_error(delay):
    # A free platform that follows a parabola: the observer's estimate is exact, and its disturbance drives it.
    g = believed(delay)._replace(actuator=CONSTANTS._replace(bias_current=0.0))
    y, v, a = 1e-6, 2e-3, 0.4
    at = moment_of_action(g, Estimate(y, v, a, 0.0), 0.0, y, v, a)
    assert at.action.y == pytest.approx(y + v * g.delay + 0.5 * a * g.delay**2, rel=1e-9)
    assert at.position_error == pytest.approx(0.0, abs=1e-18) and at.rate_error == pytest.approx(0.0, abs=1e-15)
    # Errors are counted y − r.
    ahead = moment_of_action(g, Estimate(y, v, a, 0.0), 0.0, y - 3e-7, v - 4e-5, a)
    assert ahead.position_error == pytest.approx(3e-7 + 4e-5 * g.delay) and ahead.rate_error == pytest.approx(4e-5)


@pytest.mark.parametrize("y", [0.0, 1e-5, -2e-4])
def test_the_current_for_an_acceleration_gives_it_by_the_magnets_law(y):
    g = believed()
    for acceleration in (-0.5, 0.0, 0.5):
        current = current_for(g, y, acceleration)
        force = magnetic_force(CONSTANTS, y, CONSTANTS.bias_current, current)
        assert force / g.mass == pytest.approx(acceleration, abs=1e-9)


def test_beyond_the_usable_gap_the_current_is_that_of_its_edge_and_turned_over_on_the_other_side():
    g, gap = believed(), CONSTANTS.air_gap
    assert current_for(g, 2.0 * gap, 0.0) == current_for(g, 50.0 * gap, 0.0)
    assert current_for(g, -2.0 * gap, 0.0) == -current_for(g, 2.0 * gap, 0.0) != 0.0


def test_a_current_is_limited_to_both_sides_alike():
    g = believed()
    assert [limited(g, current) for current in (-2.0, -0.9, -0.3, 0.0, 0.3, 0.9, 2.0)] == [
        -0.9,
        -0.9,
        -0.3,
        0.0,
        0.3,
        0.9,
        0.9,
    ]


def test_without_a_delay_the_next_sample_is_a_whole_period_after_the_action():
    g = believed(0.0)._replace(actuator=CONSTANTS._replace(bias_current=0.0))
    ahead = next_prior(g, Estimate(0.0, 1e-3, 0.2, 0.1), 0.4)
    assert ahead.velocity == pytest.approx(1e-3 + 0.2 * PERIOD, rel=1e-3)
    assert ahead.current == pytest.approx(0.4 - 0.3 * math.exp(-2.0 * math.pi * 500.0 * PERIOD))
