"""Repeatability by its definition, and which readings and runs are outliers."""

import math

import numpy as np
import pytest
from straightcomp_ros.straightness.survey_runs import FLOOR, disagreement, repeatability, spikes

from straightcomp_ros.straightness.feedforward import blended, weight
from straightcomp_ros.straightness.survey import Run, Survey

X = np.arange(4) * 0.01


def found_of(forward, backward):
    """Repeatability of runs given as rows of deviations in µm at four points."""
    rows = [("forward", row) for row in forward] + [("backward", row) for row in backward]
    runs = tuple(Run(str(i), way, X, np.array(row) * 1e-6) for i, (way, row) in enumerate(rows))
    return repeatability(Survey(runs), X, np.array([run.deviation for run in runs]))


def test_the_figures_are_those_of_the_standard_at_the_worst_point():
    found = found_of([[1, 0, 0, 0], [3, 0, 0, 0]], [[0, 0, 0, 5], [0, 0, 0, 9]])
    s_forward, s_backward = math.sqrt(2.0), 2.0 * math.sqrt(2.0)
    shown = found.to_display()
    assert shown["repeatability_forward_um"] == pytest.approx(4.0 * s_forward)
    assert shown["repeatability_backward_um"] == pytest.approx(4.0 * s_backward)
    assert found.reversal == pytest.approx([2e-6, 0.0, 0.0, -7e-6])
    assert shown["reversal_max_um"] == pytest.approx(7.0) and shown["reversal_mean_um"] == pytest.approx(-1.25)
    assert shown["repeatability_bidirectional_um"] == pytest.approx(2.0 * s_backward + 7.0)


def test_the_bidirectional_figure_adds_the_spreads_of_both_directions_and_the_reversal():
    found = found_of([[1, 0, 0, 0], [3, 0, 0, 0]], [[0, 0, 0, 0], [4, 0, 0, 0]])
    # s: √2 and 2√2 µm, no reversal.
    assert found.bidirectional == pytest.approx(max(6.0 * math.sqrt(2.0), 8.0 * math.sqrt(2.0)) * 1e-6)
    turned = found_of([[0, 0, 0, 0], [4, 0, 0, 0]], [[2, 0, 0, 0], [2, 0, 0, 0]])
    assert turned.bidirectional == pytest.approx(8.0 * math.sqrt(2.0) * 1e-6)
    apart = found_of([[11, 0, 0, 0], [13, 0, 0, 0]], [[0, 0, 0, 0], [4, 0, 0, 0]])
    assert apart.bidirectional == pytest.approx((6.0 * math.sqrt(2.0) + 10.0) * 1e-6)


def test_what_was_not_driven_twice_or_not_both_ways_has_no_figure():
    one = found_of([[1, 2, 3, 4]], []).to_display()
    assert set(one.values()) == {None}
    both = found_of([[1, 1, 1, 1], [1, 1, 1, 1]], [[0, 0, 0, 0]])
    assert both.bidirectional is None and both.backward.s is None and both.forward.repeatability == 0.0
    assert both.to_display()["reversal_mean_um"] == pytest.approx(1.0)
    assert found_of([], [[1, 1, 1, 1]]).forward is None


def test_the_standard_asks_for_five_runs_each_way():
    row = [0, 1, 2, 3]
    assert not found_of([row] * 5, [row] * 5).short_of_the_standard
    for forward, backward in ((4, 5), (5, 4), (5, 0), (0, 5)):
        assert found_of([row] * forward, [row] * backward).short_of_the_standard


def test_a_spike_is_further_out_than_so_many_robust_standard_deviations():
    # The median is 0, the median distance 1 µm: 1.4826 µm is one robust standard deviation.
    base = np.array([-1.0, 1.0] * 20)
    for value, spike in ((8.8, False), (9.0, True), (-8.8, False), (-9.0, True)):
        readings = np.append(base, [0.0, value, -value / 100.0]) * 1e-6
        assert spikes(readings, 6.0).tolist() == [False] * 41 + [spike, False]
        # Where the zero lies does not matter.
        assert spikes(readings + 5e-3, 6.0).tolist() == [False] * 41 + [spike, False]


def test_nothing_within_the_floor_is_a_spike():
    for value, spike in ((0.99 * FLOOR, False), (1.01 * FLOOR, True), (-1.01 * FLOOR, True)):
        assert spikes(np.append(np.zeros(20), value), 6.0)[-1] == spike


def noisy(count=5, points=40):
    return np.random.default_rng(3).normal(0.0, 3e-8, (count, points))


def test_of_three_runs_one_that_was_knocked_is_rejected_and_of_two_none():
    values = noisy(3)
    values[1, 10:22] += 3e-6
    assert disagreement(values, 6.0).runs.tolist() == [False, True, False]
    found = disagreement(values[:2], 6.0)
    assert not found.runs.any() and not found.points.any()


def test_single_points_are_rejected_up_to_three_neighbours_and_then_the_run():
    for bad, run in ((1, False), (3, False), (4, True)):
        values = noisy()
        values[2, 10 : 10 + bad] += 3e-6
        found = disagreement(values, 6.0)
        assert found.runs.tolist() == [False, False, run, False, False]
        assert np.count_nonzero(found.points) == (0 if run else bad)
    # Two stretches of three are no stretch of six.
    values = noisy()
    values[2, [3, 4, 5, 8, 9, 10]] -= 3e-6
    found = disagreement(values, 6.0)
    assert not found.runs.any() and np.flatnonzero(found.points[2]).tolist() == [3, 4, 5, 8, 9, 10]


def test_a_run_with_more_than_a_quarter_of_bad_points_is_rejected_though_none_are_neighbours():
    for bad, run in ((10, False), (11, True)):
        values = noisy()
        values[0, np.arange(bad) * 3 + 2] += 3e-6
        assert disagreement(values, 6.0).runs.tolist() == [run, False, False, False, False]


def test_the_worst_run_goes_first_and_then_the_others_are_judged_anew():
    values = noisy(7)
    values[3] += 9e-6
    values[5] += 3e-6
    assert disagreement(values, 6.0).runs.tolist() == [False, False, False, True, False, True, False]


def test_a_blend_is_the_product_rule_of_weight_and_difference():
    def old(t):
        return 1.0 + 2.0 * t + 3.0 * t * t, 2.0 + 6.0 * t, 6.0

    def new(t):
        return -1.0 + 0.5 * t - t * t, 0.5 - 2.0 * t, -2.0

    def mixed(t):
        return blended(old(t), new(t), weight(t, 0.5))

    h = 1e-4
    for t in (0.05, 0.2, 0.25, 0.4):
        (before, *_), (r, r_dot, r_ddot), (after, *_) = mixed(t - h), mixed(t), mixed(t + h)
        assert min(old(t)[0], new(t)[0]) < r < max(old(t)[0], new(t)[0])
        assert (after - before) / (2.0 * h) == pytest.approx(r_dot, rel=1e-4, abs=1e-3)
        assert (after - 2.0 * r + before) / h**2 == pytest.approx(r_ddot, rel=1e-3, abs=0.05)
    assert mixed(0.0) == old(0.0) and mixed(0.5) == new(0.5)


def test_the_weight_is_one_before_the_change_a_half_in_its_middle_and_zero_after_it():
    assert weight(-1.0, 0.5) == weight(0.0, 0.5) == (1.0, 0.0, 0.0)
    assert weight(0.5, 0.5) == weight(9.0, 0.5) == (0.0, 0.0, 0.0)
    assert weight(1.0, 2.0) == pytest.approx((0.5, -1.875 / 2.0, 0.0))
    assert weight(0.4, 2.0)[0] == pytest.approx(1.0 - 0.2**3 * (10.0 - 3.0 + 0.24))
