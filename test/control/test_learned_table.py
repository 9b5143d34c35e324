"""The table of what was learned over x: a spline with its derivatives, judged pass by pass."""

import itertools
import math

import numpy as np
import pytest
from scipy.interpolate import BSpline

from straightcomp_ros.control.learned_table import LearnedTable

SPACING = 1e-3
MARGIN = 0.05


def table():
    return LearnedTable(SPACING, MARGIN)


def restored(coefficients, first=-3, speed=0.2):
    found = table()
    count = len(coefficients)
    found.restore(first, coefficients, np.full(count, 1e-14), np.full(count, 4e-14), np.full(count, speed))
    return found


def one_pass(found, error, wanted=0.0, x=None, speed=0.2, gain=1.0, limit=1e-6, asked=None):
    """A pass over 0 to 50 mm, ten samples a node, with a constant error; what is wanted is constant, too."""
    x = np.linspace(0.0, 0.05, 501) if x is None else x

    def answer(part):
        if asked is not None:
            asked.append(part)
        return np.full(x.size, wanted)

    found.learn(x, np.full(x.size, error), np.ones(x.size), answer, np.full(x.size, speed), gain, limit)


def inside(found, at=(0.01, 0.02, 0.03, 0.04)):
    return [found.at(x, 0.2)[1] for x in at]


def test_the_correction_is_the_uniform_cubic_spline_of_its_coefficients_with_both_derivatives():
    coefficients = np.random.default_rng(1).normal(0.0, 1e-6, 12)
    found, first = restored(coefficients), -3
    # Coefficient k belongs to the node (first + k), around which its B-spline is centred.
    knots = (first + np.arange(-2, 14)) * SPACING
    spline = BSpline(knots, coefficients, 3)
    for x in np.linspace((first + 1) * SPACING, (first + 10) * SPACING - 1e-9, 200):
        weight, value, slope, curvature = found.at(x, 0.2)
        assert weight == 1.0
        assert value == pytest.approx(spline(x), abs=1e-18)
        assert slope == pytest.approx(spline(x, 1), abs=1e-14)
        assert curvature == pytest.approx(spline(x, 2), abs=1e-9)


def test_outside_of_the_table_there_is_no_correction():
    found = restored(np.full(12, 1e-6))
    for x in (-0.1, -2.01 * SPACING, 7.01 * SPACING, 0.1):
        assert found.at(x, 0.2) == (1.0, 0.0, 0.0, 0.0)
    assert found.at(-1.99 * SPACING, 0.2)[1] == pytest.approx(1e-6)
    assert found.at(6.99 * SPACING, 0.2)[1] == pytest.approx(1e-6)
    assert table().at(0.0, 0.2) == (1.0, 0.0, 0.0, 0.0)


def test_the_weight_falls_from_one_to_zero_with_the_distance_from_the_learned_speed():
    found = restored(np.full(12, 1e-6), speed=0.2)
    weights = [found.at(0.0, 0.2 * (1.0 + away))[0] for away in np.linspace(0.0, 1.0, 101)]
    assert weights[0] == 1.0 and weights[-1] == 0.0
    assert all(later <= earlier for earlier, later in itertools.pairwise(weights))
    steps = np.diff(weights)
    falling = steps[(steps < 0.0)][1:-1]
    assert len(falling) > 2 and falling == pytest.approx(falling.mean())
    for away in (0.1, 0.2, 0.3):
        slower, faster = (found.at(0.0, 0.2 * (1.0 + sign * away))[0] for sign in (-1.0, 1.0))
        assert slower == pytest.approx(faster)


def test_a_node_whose_speed_is_unknown_is_corrected_at_any_speed():
    assert restored(np.full(12, 1e-6), speed=0.0).at(0.0, 5.0)[0] == 1.0


def test_what_is_wanted_is_learned_within_the_limit_and_counted():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6)
    assert inside(found) == pytest.approx([0.4e-6] * 4)
    assert found.updates == 1 and found.tried
    one_pass(found, 0.5e-6, wanted=-5e-6)
    assert inside(found) == pytest.approx([-1e-6] * 4)
    assert found.updates == 2


def test_an_update_that_makes_things_worse_is_taken_back_and_the_next_one_is_half_as_large():
    asked = []
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6, asked=asked)
    one_pass(found, 2e-6, wanted=0.9e-6, asked=asked)
    # Worse than without: the coefficients are those of the best pass, which had none.
    assert inside(found) == pytest.approx([0.0] * 4, abs=1e-20)
    assert found.caution == 0.5 and found.updates == 1 and not found.tried
    one_pass(found, 1e-6, wanted=0.2e-6, asked=asked)
    assert asked == [1.0, 0.5]
    assert inside(found) == pytest.approx([0.2e-6] * 4)
    # That one was good: the gain may grow again.
    one_pass(found, 0.5e-6, wanted=0.3e-6, asked=asked)
    assert found.caution == 1.0 and asked[-1] == 1.0
    one_pass(found, 0.25e-6, wanted=0.3e-6, asked=asked)
    assert found.caution == 1.0 and asked[-1] == 1.0
    found.caution = 0.25
    one_pass(found, 0.1e-6, wanted=0.3e-6, asked=asked)
    assert found.caution == 0.5
    found.clear()
    assert found.caution == 1.0 and not found.tried


def test_an_error_within_the_margin_is_chance_and_no_reason_to_take_back():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6)
    one_pass(found, 1.04e-6, wanted=0.5e-6)
    assert inside(found) == pytest.approx([0.5e-6] * 4)
    assert found.caution == 1.0
    one_pass(found, 1.06e-6, wanted=0.6e-6)
    assert inside(found) == pytest.approx([0.0] * 4, abs=1e-20)


def test_the_best_is_what_stood_in_the_table_during_the_best_pass():
    found = table()
    for error, wanted in ((1.0e-6, 0.4e-6), (0.5e-6, 0.6e-6), (0.2e-6, 0.7e-6), (0.9e-6, 0.1e-6)):
        one_pass(found, error, wanted=wanted)
    # The third pass ran with 0.6 and was the best; the fourth with 0.7 was worse.
    assert inside(found) == pytest.approx([0.6e-6] * 4)
    assert np.nanmax(found.best_square) == pytest.approx(0.04e-12)
    assert np.nanmax(found.bare_square) == pytest.approx(1e-12)


def test_a_machine_that_has_changed_is_learned_anew_if_the_table_is_worse_than_nothing():
    found = table()
    for error, wanted in ((1e-6, 0.4e-6), (0.5e-6, 0.4e-6), (0.5e-6, 0.4e-6)):
        one_pass(found, error, wanted=wanted)
    one_pass(found, 0.8e-6, wanted=0.5e-6)
    assert not found.tried and inside(found) == pytest.approx([0.4e-6] * 4)
    # Without an untried update, and still better than without any: it is the best from now on.
    one_pass(found, 0.8e-6, wanted=0.5e-6)
    assert found.updates == 4 and np.nanmax(found.best_square) == pytest.approx(0.64e-12)
    one_pass(found, 3e-6, wanted=0.9e-6)
    one_pass(found, 3e-6, wanted=0.9e-6)
    assert found.updates == 0 and found.coefficients.size == 0 and found.at(0.02, 0.2)[1] == 0.0


def test_nodes_passed_at_another_speed_start_anew_and_the_others_stay():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6)
    one_pass(found, 0.5e-6, wanted=0.4e-6)
    half = np.linspace(0.0, 0.02, 201)
    one_pass(found, 2e-6, wanted=0.1e-6, x=half, speed=0.6)
    assert found.at(0.01, 0.6)[:2] == (1.0, pytest.approx(0.1e-6))
    assert found.at(0.04, 0.2)[:2] == (1.0, pytest.approx(0.4e-6))
    assert found.at(0.01, 0.2)[0] == 0.0


def test_nodes_whose_speed_is_unknown_are_judged_at_any_speed():
    found = restored(np.full(120, 0.4e-6), first=-10, speed=0.0)
    # A hundred times worse than the best, and worse than without a correction.
    one_pass(found, 1e-6, wanted=0.1e-6)
    assert found.updates == 0 and found.coefficients.size == 0


def test_a_pass_over_another_stretch_makes_the_table_longer_and_keeps_what_it_knows():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6, x=np.linspace(0.03, 0.05, 201))
    one_pass(found, 1e-6, wanted=0.2e-6, x=np.linspace(-0.02, 0.0, 201))
    one_pass(found, 1e-6, wanted=0.1e-6, x=np.linspace(0.08, 0.1, 201))
    assert inside(found, (-0.01, 0.04, 0.09)) == pytest.approx([0.2e-6, 0.4e-6, 0.1e-6])
    assert found.at(0.015, 0.2)[1] == 0.0
    assert found.first * SPACING <= -0.02
    assert (found.first + found.coefficients.size - 1) * SPACING >= 0.1
    for values in (found.best, found.best_square, found.bare_square, found.speed):
        assert values.size == found.coefficients.size


def test_only_samples_with_weight_count_and_nodes_between_them_are_interpolated():
    found = table()
    x = np.linspace(0.0, 0.05, 501)
    wanted = 1e-6 * x / 0.05
    weight = np.where(np.isin(np.floor(x / SPACING + 0.5), (20, 21, 22)), 0.0, 1.0)
    found.learn(
        x, np.full(x.size, 1e-6), weight, lambda _: np.where(weight > 0.0, wanted, 99.0), 0.2 * weight, 1.0, 1.0
    )
    assert inside(found) == pytest.approx([1e-6 * at / 0.05 for at in (0.01, 0.02, 0.03, 0.04)], abs=2e-9)
    nothing = table()
    nothing.learn(x, np.full(x.size, 1e-6), 0.0 * x, lambda _: wanted, 0.2 + 0.0 * x, 1.0, 1.0)
    assert nothing.updates == 0 and not nothing.tried


def test_a_pass_is_judged_only_where_both_it_and_the_best_one_went():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6, x=np.linspace(0.0, 0.05, 501))
    x = np.linspace(0.0, 0.1, 1001)
    # Worse where nothing was known, better where the best pass was.
    error = np.where(x < 0.05, 0.5e-6, 9e-6)
    found.learn(x, error, np.ones(x.size), lambda _: np.full(x.size, 0.6e-6), np.full(x.size, 0.2), 1.0, 1e-6)
    assert found.updates == 2 and inside(found) == pytest.approx([0.6e-6] * 4)


def test_a_short_pass_is_judged_by_what_it_went_over():
    found = table()
    one_pass(found, 1e-6, wanted=0.4e-6)
    half = np.linspace(0.0, 0.02, 201)
    one_pass(found, 2e-6, wanted=0.9e-6, x=half)
    assert inside(found, (0.005, 0.01)) == [0.0, 0.0] and found.caution == 0.5 and found.updates == 1
    one_pass(found, 0.5e-6, wanted=0.3e-6, x=half)
    assert inside(found, (0.005, 0.01)) == pytest.approx([0.3e-6] * 2) and found.updates == 2


def test_a_restored_table_is_the_best_and_has_been_learned_long_ago():
    found = restored(np.full(12, 1e-6))
    assert np.array_equal(found.best, found.coefficients) and not found.tried
    assert found.caution == 1.0 and found.updates > 10
    assert math.isclose(found.at(0.0, 0.2)[1], 1e-6)
