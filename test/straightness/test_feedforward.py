"""The feedforward: chain rule on the map, estimates from the stamps, no trap in lost or repeated samples."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from straightcomp_ros.straightness.feedforward import Feedforward, FeedforwardParameters
from straightcomp_ros.straightness.guide_map import MapParameters, StraightnessMap, load_map

PERIOD_NS = 500_000
T = PERIOD_NS * 1e-9
QUANTUM = 0.1e-6


@pytest.fixture(scope="module")
def straightness() -> StraightnessMap:
    return load_map(MapParameters(file="config/guide_synthetic.csv"))


def _profile() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """x, v, a (n,) of one stroke: 0.2 m/s², 0.3 m/s, 1.76 m, standing 0.25 s before and after."""
    t = np.arange(-500, 15_235) * T
    ramp, total = 1.5, 1.76 / 0.3 + 1.5
    v = np.interp(t, [0.0, ramp, total - ramp, total], [0.0, 0.3, 0.3, 0.0])
    a = np.where((t > 0.0) & (t <= ramp), 0.2, 0.0) - np.where((t > total - ramp) & (t <= total), 0.2, 0.0)
    rising, cruise, falling = (
        np.clip(t, 0.0, ramp),
        np.clip(t - ramp, 0.0, total - 2 * ramp),
        total - np.clip(t, total - ramp, total),
    )
    return 0.1 * rising**2 + 0.3 * cruise + 0.1 * (ramp**2 - falling**2), v, a


def _run(feedforward: Feedforward, x: NDArray[np.float64], first: int = 0) -> NDArray[np.float64]:
    """(n, 3): r, ṙ, r̈ for each sample."""
    return np.array([feedforward.step((first + k) * PERIOD_NS, value) for k, value in enumerate(x.tolist())])


def test_the_reference_is_taken_at_the_measured_x_without_lag(straightness: StraightnessMap) -> None:
    x = _profile()[0]
    np.testing.assert_array_equal(_run(Feedforward(straightness), x)[:, 0], straightness.evaluate(x)[0])


def test_a_stroke_seen_by_the_encoder_is_fed_forward_within_these_figures(straightness: StraightnessMap) -> None:
    x, v, a = _profile()
    _, slope, curvature = straightness.evaluate(x)
    got = _run(Feedforward(straightness), np.round(x / QUANTUM) * QUANTUM)
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


def test_a_restart_in_full_motion_costs_one_sample(straightness: StraightnessMap) -> None:
    x, v, _ = _profile()
    cruise = slice(6000, 7000)
    got = _run(Feedforward(straightness), x[cruise])
    exact = straightness.evaluate(x[cruise])[1] * v[cruise]
    assert tuple(got[0, 1:]) == (0.0, 0.0)
    np.testing.assert_allclose(got[1:, 1], exact[1:], atol=1e-12)


def test_a_repeated_stamp_gives_the_same_answer_and_changes_nothing(straightness: StraightnessMap) -> None:
    x = _profile()[0][5000:5200]
    once, twice = Feedforward(straightness), Feedforward(straightness)
    for k, value in enumerate(x.tolist()):
        answer = twice.step(k * PERIOD_NS, value)
        assert twice.step(k * PERIOD_NS, value + 1.0) == answer
        assert once.step(k * PERIOD_NS, value) == answer


def test_the_same_samples_give_the_same_bits(straightness: StraightnessMap) -> None:
    x = _profile()[0]
    feedforward = Feedforward(straightness)
    first = _run(feedforward, x)
    feedforward.reset()
    np.testing.assert_array_equal(_run(feedforward, x), first)


def test_lost_samples_do_not_matter(straightness: StraightnessMap) -> None:
    x, v, _ = _profile()
    feedforward = Feedforward(straightness)
    kept = [k for k in range(5000, 9000) if k % 7 not in (2, 3, 4)]
    for number, k in enumerate(kept):
        r_dot = feedforward.step(k * PERIOD_NS, float(x[k]))[1]
        if number > 1:
            assert r_dot == pytest.approx(straightness.reference(float(x[k]))[1] * v[k], abs=1e-12)


@pytest.mark.parametrize(
    ("stamp_after", "x_after"),
    [(-1, 0.9001), (10_000_000, 0.9001), (201, 0.9002 + 0.01), (201, math.nan), (201, math.inf)],
    ids=["stamp goes back", "long gap", "jump of x", "not a number", "infinite"],
)
def test_what_no_stage_does_starts_the_estimate_anew(
    straightness: StraightnessMap, stamp_after: int, x_after: float
) -> None:
    feedforward = Feedforward(straightness)
    for k in range(201):
        assert feedforward.step(k * PERIOD_NS, 0.87 + 0.3 * T * k)
    assert feedforward._tracked.v == pytest.approx(0.3)
    _, r_dot, r_ddot = feedforward.step(stamp_after * PERIOD_NS, x_after)
    if math.isfinite(x_after):
        assert (r_dot, r_ddot) == (0.0, 0.0)
    else:
        assert math.isnan(r_dot)
    assert feedforward._tracked.v == 0.0


def test_after_a_bad_sample_the_next_good_ones_count_again(straightness: StraightnessMap) -> None:
    feedforward = Feedforward(straightness)
    feedforward.step(0, math.nan)
    for k in range(1, 5):
        r, r_dot, r_ddot = feedforward.step(k * PERIOD_NS, 0.9 + 0.3 * T * k)
        assert math.isfinite(r) and math.isfinite(r_dot) and math.isfinite(r_ddot)
    assert r_dot == pytest.approx(0.3 * straightness.reference(0.9 + 0.3 * T * 4)[1], rel=1e-9)


def test_stamps_of_a_real_clock_lose_no_precision(straightness: StraightnessMap) -> None:
    x = _profile()[0][5000:6000]
    late = _run(Feedforward(straightness), x, first=1_800_000_000 * 2000)
    np.testing.assert_array_equal(late, _run(Feedforward(straightness), x))


def test_the_limits_are_parameters(straightness: StraightnessMap) -> None:
    feedforward = Feedforward(straightness, FeedforwardParameters(restart_gap=1e-3), highest_speed=0.1)
    feedforward.step(0, 0.5)
    feedforward.step(1_000_000, 0.5 + 0.9e-4)
    assert feedforward._tracked.v == pytest.approx(0.09)
    feedforward.step(2_000_000, 0.5 + 2.0e-4)  # 0.11 m/s
    assert feedforward._tracked.v == 0.0
    feedforward.step(3_000_000, 0.5 + 2.5e-4)
    feedforward.step(4_000_001, 0.5 + 3.0e-4)
    assert feedforward._tracked.v == 0.0
