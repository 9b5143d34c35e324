"""The feedforward: chain rule on the map, estimates from the stamps, a change of map without a bump."""

import math

import numpy as np
import pytest
from surveys import GUIDE

from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import (
    FADE_TIME,
    Feedforward,
    FeedforwardParameters,
    blended,
    restarted,
    updated,
    weight,
)

PERIOD_NS = 500_000
T = PERIOD_NS * 1e-9
QUANTUM = 0.1e-6
BANDWIDTH = FeedforwardParameters().bandwidth


def _profile():
    """x, v, a (n,) of one stroke: 0.2 m/s², 0.3 m/s, 1.76 m, standing 0.25 s before and after."""
    t = np.arange(-500, 15_235) * T
    ramp, total = 1.5, 1.76 / 0.3 + 1.5
    v = np.interp(t, [0.0, ramp, total - ramp, total], [0.0, 0.3, 0.3, 0.0])
    a = np.where((t > 0.0) & (t <= ramp), 0.2, 0.0) - np.where((t > total - ramp) & (t <= total), 0.2, 0.0)
    rising, falling = np.clip(t, 0.0, ramp), total - np.clip(t, total - ramp, total)
    cruise = np.clip(t - ramp, 0.0, total - 2 * ramp)
    return 0.1 * rising**2 + 0.3 * cruise + 0.1 * (ramp**2 - falling**2), v, a


def _run(feedforward, x):
    """(n, 3): r, ṙ, r̈ for each sample."""
    return np.array([feedforward.step(k * PERIOD_NS, value) for k, value in enumerate(x.tolist())])


def test_a_stroke_seen_by_the_encoder_is_fed_forward_within_these_figures():
    x, v, a = _profile()
    _, slope, curvature = GUIDE.evaluate(x)
    read = np.round(x / QUANTUM) * QUANTUM
    feedforward = Feedforward(GUIDE)
    got = _run(feedforward, read)
    # The reference is taken at the measured x without lag; after a reset the same samples give the same bits.
    np.testing.assert_array_equal(got[:, 0], GUIDE.evaluate(read)[0])
    feedforward.reset()
    np.testing.assert_array_equal(_run(feedforward, read[:1000]), got[:1000])
    rate_error = got[:, 1] - slope * v
    acceleration_error = got[:, 2] - (curvature * v**2 + slope * a)
    steady = np.ones(x.size, bool)
    for corner in (500, 3500, 12_233, 15_233):  # where the acceleration jumps, and 100 ms on
        steady[corner - 2 : corner + 200] = False
    # Noise from the encoder's quantum: of ṙ up to 36 µm/s, 0.02 nm/s; of r̈ up to 380 µm/s², 0.001 µm/s².
    assert np.abs(slope * v).max() > 30e-6
    assert rate_error[steady].std() < 0.025e-9
    assert acceleration_error[steady].std() < 0.002e-6
    # Lag where the acceleration jumps by 0.2 m/s²: ṙ is off by 0.08 µm/s, which over the 7.3 ms that the loop
    # would lag without it is 0.6 nm; r̈ by 18 µm/s², 55 µN on 3 kg.
    assert np.abs(rate_error).max() < 0.08e-6
    assert np.abs(acceleration_error).max() < 20e-6


def test_the_rates_between_two_references_are_those_of_what_is_between_them():
    t, h = 0.03, 1e-4
    old = [(np.sin(40.0 * u), 40.0 * np.cos(40.0 * u), -1600.0 * np.sin(40.0 * u)) for u in (t - h, t, t + h)]
    new = [(u * u, 2.0 * u, 2.0) for u in (t - h, t, t + h)]
    fades = [weight(u, 0.1) for u in (t - h, t, t + h)]
    (before, *_), (now, rate, acceleration), (after, *_) = map(blended, old, new, fades)
    assert rate == pytest.approx((after - before) / (2.0 * h), rel=1e-3)
    assert acceleration == pytest.approx((after - 2.0 * now + before) / h**2, rel=1e-3)


@pytest.mark.parametrize("duration", [0.1, 0.5, 3.0])
def test_the_weight_falls_from_one_to_zero_as_the_integral_of_its_rate_which_is_that_of_its_acceleration(duration):
    t = np.linspace(0.0, duration, 2001)
    w, rate, acceleration = np.transpose([weight(at, duration) for at in t.tolist()])
    np.testing.assert_allclose(np.gradient(w, t)[1:-1], rate[1:-1], atol=1e-5 / duration)
    np.testing.assert_allclose(np.gradient(rate, t)[1:-1], acceleration[1:-1], atol=1e-3 / duration**2)
    for at, value in ((-0.5 * duration, 1.0), (0.0, 1.0), (duration, 0.0), (1.5 * duration, 0.0)):
        assert weight(at, duration) == pytest.approx((value, 0.0, 0.0), abs=1e-12)


def test_a_repeated_stamp_gives_the_same_answer_and_changes_nothing():
    once, twice = Feedforward(GUIDE), Feedforward(GUIDE)
    for k, x in enumerate(_profile()[0][5000:5200].tolist()):
        answer = twice.step(k * PERIOD_NS, x)
        assert twice.step(k * PERIOD_NS, x + 1.0) == once.step(k * PERIOD_NS, x) == answer


@pytest.mark.parametrize("acceleration", [0.2, 5.0, 50.0])
def test_fast_ramps_are_tracked_so_that_the_platform_lacks_no_more_way_than_a_count_hides(acceleration):
    stage = from_mapping(StageParameters, {"motion.acceleration": acceleration})
    bandwidth = stage.tracking(FeedforwardParameters(), GUIDE).bandwidth
    tracked, lacking = restarted(0.0)._replace(samples=0), 0.0  # long at rest: the gains are the steady ones
    for t in (np.arange(2000) * T).tolist():
        tracked = updated(bandwidth, tracked, T, 0.5 * acceleration * t * t)
        lacking += GUIDE.steepest * T * (acceleration * t - tracked.v)
    raised = bandwidth > BANDWIDTH
    assert raised == (acceleration > 0.2)
    assert (0.7 if raised else 0.0) <= lacking / stage.encoder.y_rounding <= 1.1


def test_lost_samples_do_not_matter():
    x, v, _ = _profile()
    feedforward = Feedforward(GUIDE)
    kept = [k for k in range(5000, 9000) if k % 7 not in (2, 3, 4)]
    for number, k in enumerate(kept):
        r_dot = feedforward.step(k * PERIOD_NS, float(x[k]))[1]
        if number > 1:
            assert r_dot == pytest.approx(GUIDE.reference(float(x[k]))[1] * v[k], abs=1e-12)


@pytest.mark.parametrize(
    ("stamp_after", "x_after"),
    [(-1, 0.9001), (10_000_000, 0.9001), (201, 0.9002 + 0.01), (201, math.nan), (201, math.inf)],
    ids=["stamp goes back", "long gap", "jump of x", "not a number", "infinite"],
)
def test_what_no_stage_does_starts_the_estimate_anew(stamp_after, x_after):
    feedforward = Feedforward(GUIDE)
    for k in range(201):
        assert feedforward.step(k * PERIOD_NS, 0.87 + 0.3 * T * k)
    first = stamp_after * PERIOD_NS
    _, r_dot, r_ddot = feedforward.step(first, x_after)
    assert (r_dot, r_ddot) == (0.0, 0.0) if math.isfinite(x_after) else math.isnan(r_dot)
    # The samples after it count again.
    for k in range(1, 5):
        x = (x_after if math.isfinite(x_after) else 0.9) + 0.3 * T * k
        answer = feedforward.step(first + k * PERIOD_NS, x)
    assert answer[1] == pytest.approx(0.3 * GUIDE.reference(x)[1], rel=1e-9)


@pytest.mark.parametrize(("stamp_after", "distance"), [(2_000_000, 1.1e-4), (2_000_001, 0.5e-4)])
def test_the_limits_are_parameters(stamp_after, distance):
    feedforward = Feedforward(GUIDE, FeedforwardParameters(restart_gap=1e-3), highest_speed=0.1)
    feedforward.step(0, 0.5)
    feedforward.step(1_000_000, 0.5 + 0.9e-4)
    assert feedforward._tracked.v == pytest.approx(0.09)
    feedforward.step(stamp_after, 0.5 + 0.9e-4 + distance)
    assert feedforward._tracked.v == 0.0


def test_a_count_that_is_more_than_a_slow_stage_moves_between_two_samples_does_not_restart_the_estimate():
    count, v = 1e-6, 5e-4
    feedforward = Feedforward(GUIDE, highest_speed=1e-3, noise=EncoderParameters(x_resolution=count).x_noise)
    _run(feedforward, 0.5 + np.round(np.arange(2000) * v * T / count) * count)
    assert feedforward._tracked.v == pytest.approx(v, rel=0.2)


SPEED = 0.1
BEFORE, AFTER = 600, 1400
FADE = round(FADE_TIME / T)
DIFFERENCE = 20e-6


def other(x):
    """The reference of another map: 20 µm away."""
    r, slope, curvature = GUIDE.reference(x)
    return r + DIFFERENCE, slope, curvature


def references(change):
    feedforward = Feedforward(GUIDE)
    found = []
    for step in range(BEFORE + AFTER):
        if step == BEFORE:
            change(feedforward)
        found.append(feedforward.step(step * PERIOD_NS, 0.2 + SPEED * step * T))
    assert not feedforward.changing
    return np.array(found)


def test_a_change_of_map_reaches_the_bounds_of_the_rates_that_belong_to_it_and_no_more():
    plain = references(lambda feedforward: None)
    changed = references(lambda feedforward: feedforward.change(other))
    beyond = changed - plain
    assert abs(beyond[:, 1]).max() == pytest.approx(1.875 * DIFFERENCE / FADE_TIME, rel=1e-6)
    assert abs(beyond[:, 2]).max() == pytest.approx(5.774 * DIFFERENCE / FADE_TIME**2, rel=1e-4)
    # The jerk jumps where the change begins and ends.
    for order, fading in ((0, slice(1, -1)), (1, slice(BEFORE + 2, BEFORE + FADE - 2))):
        np.testing.assert_allclose(np.gradient(beyond[:, order], T)[fading], beyond[fading, order + 1], atol=1e-8)
    np.testing.assert_array_equal(beyond[:BEFORE], 0.0)
    np.testing.assert_allclose(beyond[BEFORE + FADE :] - [DIFFERENCE, 0.0, 0.0], 0.0, rtol=0, atol=1e-17)
    # Before the first sample a map is changed at once.
    feedforward = Feedforward(GUIDE)
    feedforward.change(other)
    assert feedforward.step(0, 0.2)[0] == pytest.approx(GUIDE.reference(0.2)[0] + DIFFERENCE)
    # While no samples come it may be changed again, and the fade begins with the map of the last sample.
    feedforward.change(GUIDE.reference)
    assert not feedforward.changing
    feedforward.change(other)
    found = [feedforward.step(step * PERIOD_NS, 0.2)[0] for step in range(1, FADE + 1)]
    assert found == pytest.approx([GUIDE.reference(0.2)[0] + DIFFERENCE] * FADE, abs=1e-15)
    # A stamp that goes back before the change ends it.
    feedforward.change(GUIDE.reference)
    assert feedforward.step((FADE + 1) * PERIOD_NS, 0.2)[0] == pytest.approx(found[-1]) and feedforward.changing
    assert feedforward.step((FADE - 1) * PERIOD_NS, 0.2)[0] == GUIDE.reference(0.2)[0] and not feedforward.changing


def test_after_a_start_it_is_least_squares_over_all_samples_from_the_third_on():
    t = np.arange(30) * T
    x = 0.1 * t + 1e-6 * np.random.default_rng(3).standard_normal(t.size)
    tracked = restarted(float(x[0]))
    for count, value in enumerate(x[1:].tolist(), 2):
        tracked = updated(10.0, tracked, T, value)
        if count > 2:
            fit = np.polynomial.Polynomial.fit(t[:count], x[:count], 2)
            assert tracked.v == pytest.approx(fit.deriv()(t[count - 1]), rel=1e-9)
            assert tracked.a == pytest.approx(fit.deriv(2)(t[count - 1]), rel=1e-9)


def test_all_three_poles_lie_at_theta():
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
