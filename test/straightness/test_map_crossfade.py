"""A change of map leaves no bump in the reference, nor in the command."""

import itertools
import math

import numpy as np
import pytest

from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.servo import Servo
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import FADE_TIME, Feedforward, weight
from straightcomp_ros.straightness.guide_map import MapParameters, load_map

STAGE = StageParameters()
T = STAGE.period_ns
DT = T * 1e-9
SPEED = 0.1
BEFORE, AFTER = 600, 1400
FADE = round(FADE_TIME / DT)
DIFFERENCE = 20e-6


@pytest.fixture(scope="module")
def straightness():
    return load_map(MapParameters())


def other(straightness):
    """Another map: 20 µm away."""

    def reference(x):
        r, slope, curvature = straightness.reference(x)
        return r + DIFFERENCE, slope, curvature

    return reference


def references(straightness, change):
    feedforward = Feedforward(straightness)
    found = []
    for step in range(BEFORE + AFTER):
        if step == BEFORE:
            change(feedforward)
        found.append(feedforward.step(step * T, 0.2 + SPEED * step * DT))
    assert not feedforward.changing
    return np.array(found)


def test_the_weight_and_its_rates_belong_together():
    times = np.linspace(-0.1, FADE_TIME + 0.1, 70_001)
    w, w_dot, w_ddot = np.array([weight(t, FADE_TIME) for t in times]).T
    h = times[1] - times[0]
    assert w[0] == 1.0 and w[-1] == 0.0
    np.testing.assert_allclose(np.gradient(w, h), w_dot, atol=1e-3)
    np.testing.assert_allclose(np.gradient(w_dot, h), w_ddot, atol=0.02)
    assert abs(w_dot).max() == pytest.approx(1.875 / FADE_TIME, rel=1e-6)
    assert abs(w_ddot).max() == pytest.approx(5.774 / FADE_TIME**2, rel=1e-4)


def test_the_reference_and_its_rates_stay_within_the_bounds_of_the_change(straightness):
    plain = references(straightness, lambda feedforward: None)
    changed = references(straightness, lambda feedforward: feedforward.change(other(straightness)))
    beyond = changed - plain
    assert abs(np.diff(beyond[:, 0])).max() <= 1.875 * DIFFERENCE / FADE_TIME * DT * 1.0001
    assert abs(beyond[:, 1]).max() <= 1.875 * DIFFERENCE / FADE_TIME * 1.0001
    assert abs(beyond[:, 2]).max() <= 5.774 * DIFFERENCE / FADE_TIME**2 * 1.0001
    np.testing.assert_allclose(np.gradient(beyond[:, 0], DT)[1:-1], beyond[1:-1, 1], atol=1e-8)
    np.testing.assert_array_equal(beyond[:BEFORE], 0.0)
    np.testing.assert_allclose(beyond[BEFORE + FADE :, 0], DIFFERENCE, rtol=1e-12)


def test_before_the_first_sample_a_map_is_changed_at_once(straightness):
    feedforward = Feedforward(straightness)
    feedforward.change(other(straightness))
    assert feedforward.step(0, 0.2)[0] == pytest.approx(straightness.reference(0.2)[0] + DIFFERENCE)


def test_the_command_does_not_step_further_during_a_change_of_map_than_without_one(straightness):
    def currents(change):
        machine = SimulatedHardware(SimulatedParameters(), STAGE, straightness)
        feedforward = Feedforward(straightness)
        servo = Servo(make_law(ControlParameters(law="smc_observer"), STAGE))
        machine.start(0)
        machine.enable()
        found, errors = [], []
        for step in range(BEFORE + AFTER):
            if step == BEFORE:
                change(feedforward)
            [(sample, _)] = machine.read(step * T)
            r = feedforward.step(sample.stamp_ns, 0.2 + SPEED * step * DT)
            answer = servo.step(sample.stamp_ns, sample.y, sample.current, r)
            machine.write(answer.current, sample.stamp_ns + T // 2)
            found.append(answer.current)
            errors.append(answer.error)
        steps = [abs(b - a) for a, b in itertools.pairwise(found[BEFORE - 200 :])]
        return max(steps), max(map(abs, errors[BEFORE - 200 :]))

    plain, plain_error = currents(lambda feedforward: None)
    changed, changed_error = currents(lambda feedforward: feedforward.change(other(straightness)))
    assert math.isfinite(changed)
    # K_y D / K_i is the current that the other place takes; it comes over the whole fade.
    assert changed <= 1.5 * plain + 1.875 * (29.8e3 * DIFFERENCE / 44.7) * DT / FADE_TIME
    assert changed_error < plain_error + 0.3e-6
