import math
import random

import numpy as np
import pytest

from straightcomp_ros.control.observer import observer_gains
from straightcomp_ros.control.smc_observer import Lags, LagWeights, SizeGains, fit_at_start, fitted, lagged

PERIOD, BANDWIDTH, THIRD = 5e-4, 199.0, 1.28
POLE = math.exp(-2.0 * math.pi * BANDWIDTH * PERIOD)
WEIGHTS = LagWeights(double=1.0 - POLE, third=1.0 - POLE**THIRD)
GAINS = SizeGains(kept=math.exp(-PERIOD / 2.0), smooth=0.17, mean=PERIOD / 0.3, travel=25e-6, speed=1e-7, largest=4.0)


def samples(count):
    """r, ṙ and F̄ of an ever changing motion with a reversing friction of 0.25 m/s²."""
    for k in range(count):
        angle = 2.0 * math.pi * 3.0 * k * PERIOD
        yield 1e-5 * math.sin(angle), 1.9e-4 * math.cos(angle), -0.25 * math.tanh(20.0 * math.cos(angle))


def after(count, size, *, first=0.15, constant=0.0, slope=0.0, noise=0.0):
    """The fit to a disturbance of friction of ``size`` and others, with the law taking over what it fits."""
    fit, source = fit_at_start(first), random.Random(1)
    for r, r_dot, unit in samples(count):
        friction = lagged(WEIGHTS, fit.lags, unit).third
        total = constant + slope * r / GAINS.travel + size * friction + source.gauss(0.0, noise)
        fit = fitted(GAINS, WEIGHTS, fit, r, r_dot, unit, total - fit.size * friction)
    return fit


def test_the_lags_are_those_of_the_observers_estimate_of_an_acceleration():
    gains = np.array(observer_gains(BANDWIDTH, THIRD, PERIOD))
    step = np.array([[1, PERIOD, PERIOD**2 / 2], [0, 1, PERIOD], [0, 0, 1]])
    estimate, plant, lags = np.zeros(3), np.zeros(3), Lags(0.0, 0.0, 0.0, 0.0, 0.0)
    source = random.Random(2)
    for _ in range(200):
        estimate = estimate + gains * (plant[0] - estimate[0])
        plant[2] = source.uniform(-1.0, 1.0)
        lags = lagged(WEIGHTS, lags, plant[2])
        assert estimate[2] == pytest.approx(lags.third, abs=1e-9)
        estimate, plant = step @ estimate, step @ plant


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_the_size_of_friction_is_found_beside_a_constant_and_an_error_of_stiffness(size):
    fit = after(2000, size, constant=0.05, slope=-0.08)
    assert fit.size == pytest.approx(size, rel=0.02)
    assert fit.constant == pytest.approx(0.05, abs=0.005) and fit.slope == pytest.approx(-0.08, abs=0.01)


def test_noise_as_large_as_friction_moves_the_size_by_less_than_a_fifth():
    assert after(6000, 1.0, noise=0.25).size == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(("size", "bound"), [(-1.0, 0.1), (9.0, 4.0)])
def test_the_size_stays_within_its_bounds(size, bound):
    assert after(2000, size).size == bound


def test_the_misfit_is_what_friction_of_any_size_does_not_explain():
    explained, unexplained = after(4000, 2.5, constant=0.1), fit_at_start(0.15)
    for k, (r, r_dot, unit) in enumerate(samples(4000)):
        friction = lagged(WEIGHTS, unexplained.lags, unit).third
        strange = 0.1 * math.sin(2.0 * math.pi * 20.0 * k * PERIOD)
        unexplained = fitted(
            GAINS, WEIGHTS, unexplained, r, r_dot, unit, friction + strange - unexplained.size * friction
        )
    assert math.sqrt(explained.misfit_square) < 0.005
    # 20 Hz pass a smoothing of some 60 Hz nearly whole.
    assert math.sqrt(unexplained.misfit_square) == pytest.approx(0.1 / math.sqrt(2.0), rel=0.1)


def test_noise_of_the_encoder_is_hardly_a_misfit():
    assert math.sqrt(after(4000, 1.0, noise=0.1).misfit_square) < 0.035


def test_while_the_reference_rests_the_fit_is_paused():
    fit = after(500, 1.0)
    rested = fitted(GAINS, WEIGHTS, fit, 1e-5, 1e-7, 0.2, 5.0)
    assert rested[:11] == fit[:11] and rested.lags != fit.lags


def test_without_excitation_the_fit_neither_grows_beyond_bounds_nor_loses_the_size():
    fit = after(2000, 1.0)
    for _ in range(100_000):
        fit = fitted(GAINS, WEIGHTS, fit, 0.0, 1e-3, 0.0, 0.0)
    assert fit.size == pytest.approx(1.0, rel=0.02)
    assert all(abs(number) < 20.0 for number in fit[:9])
    for r, r_dot, unit in samples(2000):
        friction = lagged(WEIGHTS, fit.lags, unit).third
        fit = fitted(GAINS, WEIGHTS, fit, r, r_dot, unit, (2.0 - fit.size) * friction)
    assert fit.size == pytest.approx(2.0, rel=0.05)
