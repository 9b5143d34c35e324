import numpy as np
import pytest

from straightcomp_ros.model.actuator import UNIT_GAIN_ERROR_LIMIT
from straightcomp_ros.tuning.paper.friction import stick_slip
from straightcomp_ros.tuning.paper.gain_error import FAR, far_release, gain_error_limit, largest_gain_error, returns
from straightcomp_ros.tuning.paper.machine import (
    AMPLITUDE,
    OMEGA,
    UNCLAMPED,
    evaluated,
    follow_sine,
    fundamental,
    hold_still,
    release,
)
from straightcomp_ros.tuning.paper.surface import NEAR, following_error_gain, lag, near_release, reaching_time


def test_the_gain_error_limit_found_is_the_closed_form():
    assert gain_error_limit() == pytest.approx(UNIT_GAIN_ERROR_LIMIT, abs=1e-9)
    assert gain_error_limit() == pytest.approx(0.3660, abs=5e-5)


def test_beyond_the_limit_some_current_makes_the_gain_error_exceed_one():
    assert largest_gain_error(UNIT_GAIN_ERROR_LIMIT - 1e-3) < 1.0 < largest_gain_error(UNIT_GAIN_ERROR_LIMIT + 1e-3)


@pytest.fixture(scope="module")
def far(machine):
    return far_release(machine)


def test_released_far_out_the_unclamped_law_drives_the_platform_against_its_stop(far, machine):
    assert far.unclamped.y[-1] == machine.plant.platform.stop
    assert np.abs(far.unclamped.y).min() >= FAR * far.air_gap


def test_released_far_out_the_clamped_law_brings_the_platform_back(far):
    assert abs(far.clamped.y[-1]) < 1e-2 * far.air_gap
    assert np.abs(far.clamped.command).max() <= far.bias_current


def test_the_unclamped_law_loses_the_platform_within_the_gain_error_limit(far, machine):
    """|m_i| ≤ 1 holds for |i_c| ≤ I0 only, and the unclamped law asks for more."""
    assert NEAR < far.returns_from < UNIT_GAIN_ERROR_LIMIT
    assert not returns(machine.idealised().with_law("smc"), far.returns_from + 0.01)


@pytest.fixture(scope="module")
def near(machine):
    return near_release(machine)


def test_the_surface_is_reached_at_the_time_of_the_closed_form(near):
    """Within a tenth: m_i and friction, which the closed form leaves out, pull both ways."""
    closed = reaching_time(near.design.phi, near.design.rho, near.sigma_0)
    assert near.response.time[near.reached] == pytest.approx(closed, rel=0.1)


def test_on_the_surface_the_motion_is_that_of_equation_12(near):
    assert abs(near.closed_y[0]) > 10e-6
    assert np.abs(near.response.y[near.reached :] - near.closed_y).max() < 1e-6


def test_once_reached_the_surface_is_not_left_again(near):
    sliding = np.abs(near.response.sigma[near.reached + 1 :])
    assert sliding.max() < 0.01 * near.sigma_0


def test_without_friction_the_sine_is_followed_with_the_lag_of_equation_12(machine):
    ideal = machine.idealised().with_law("linear").without_friction()
    response = follow_sine(ideal)
    window = evaluated(response)
    error = (response.reference - response.y)[window]
    amplitude = fundamental(response.time[window], error)
    design = ideal.control.smc
    assert amplitude == pytest.approx(following_error_gain(design, OMEGA) * AMPLITUDE, rel=0.01)
    assert amplitude == pytest.approx(lag(design) * OMEGA * AMPLITUDE, rel=0.01)
    assert amplitude == pytest.approx(1.83e-6, rel=0.01)


def test_with_friction_the_platform_sticks_once_at_each_reversal(machine):
    data = stick_slip(machine)
    reversals = np.abs(data.run.reference[data.sticks[:, 0]])
    assert len(data.sticks) == 4
    assert reversals.min() > 0.95 * AMPLITUDE


def test_the_idealised_machine_is_not_limited(machine):
    ideal = machine.idealised()
    assert ideal.stage.actuator.current_limit == UNCLAMPED
    assert ideal.plant.drive.converted(-5.0) == pytest.approx(-5.0, abs=1e-4)


def test_at_rest_at_the_centre_nothing_happens(machine):
    response = release(machine.idealised().with_law("smc"), 0.0, hold_still(machine.idealised(), 0.01))
    assert not response.y.any() and not response.command.any()
