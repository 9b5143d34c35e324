"""The tracking filter: exact on what it models, critically damped, right after three samples."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.straightness.feedforward import restarted, updated

T = 5e-4


@given(
    position=st.floats(-2.0, 2.0),
    velocity=st.floats(-1.0, 1.0),
    acceleration=st.floats(-5.0, 5.0),
    bandwidth=st.floats(5.0, 200.0),
    samples=st.integers(3, 400),
)
def test_a_constant_acceleration_is_followed_exactly_from_the_third_sample(
    position: float, velocity: float, acceleration: float, bandwidth: float, samples: int
) -> None:
    tracked = restarted(position)
    t = np.arange(samples) * T
    for x in (position + velocity * t + 0.5 * acceleration * t**2)[1:].tolist():
        tracked = updated(bandwidth, tracked, T, x)
    # Rounding of x: 4e-16 m over a sample is 1e-12 m/s and 2e-9 m/s².
    assert tracked.v == pytest.approx(velocity + acceleration * t[-1], abs=1e-9)
    assert tracked.a == pytest.approx(acceleration, abs=1e-6)


def test_after_a_start_it_is_least_squares_over_all_samples() -> None:
    t = np.arange(30) * T
    x = 0.1 * t + 1e-6 * np.random.default_rng(3).standard_normal(t.size)
    tracked = restarted(float(x[0]))
    for value in x[1:].tolist():
        tracked = updated(10.0, tracked, T, value)
    fit = np.polynomial.Polynomial.fit(t, x, 2)
    assert tracked.v == pytest.approx(fit.deriv()(t[-1]), rel=1e-9)
    assert tracked.a == pytest.approx(fit.deriv(2)(t[-1]), rel=1e-9)


def test_all_three_poles_lie_at_theta() -> None:
    # A disturbance dies as (c0 + c1 n + c2 n²) θⁿ: divided by θⁿ, its third difference is zero.
    bandwidth = 30.0
    tracked = restarted(0.0)
    for _ in range(500):
        tracked = updated(bandwidth, tracked, T, 0.0)
    tracked = tracked._replace(v=1.0)
    theta = math.exp(-2.0 * math.pi * bandwidth * T)
    scaled = []
    for n in range(40):
        tracked = updated(bandwidth, tracked, T, 0.0)
        scaled.append(tracked.v / theta**n)
    assert np.abs(np.diff(scaled, 3)).max() < 1e-10


def test_lost_samples_do_not_disturb_a_steady_motion() -> None:
    tracked = restarted(0.0)
    x = 0.0
    for lost in np.random.default_rng(5).integers(0, 20, 500).tolist():
        dt = T * (1 + lost)
        x += 0.3 * dt
        tracked = updated(30.0, tracked, dt, x)
        assert tracked.v == pytest.approx(0.3, abs=1e-9)
