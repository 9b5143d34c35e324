"""Filters in the loop: what they let through, what they take out, and what the margins make of them and of modes."""

import math

import numpy as np
import pytest

from straightcomp_ros.control.filters import (
    EMPTY,
    NONE,
    FilterParameters,
    HumParameters,
    NotchParameters,
    RollOffParameters,
    filtered,
    filters_of,
    turned_gain,
)
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import (
    StateSpace,
    closed_loop,
    linearised,
    loop_margins,
    loop_response,
    missing_margin,
    sampled_plant,
    spectral_radius,
    with_modes_off,
)
from straightcomp_ros.model.modes import ModeParameters
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
PERIOD = STAGE.period


def response(parameters, frequencies):
    """Of the filters from the current asked for to that answered, by their answer to an impulse."""
    f, memory, answers = filters_of(parameters, PERIOD), EMPTY, []
    for k in range(8000):
        answer, memory = filtered(f, memory, 1.0 if k == 0 else 0.0, 0.0)
        answers.append(answer)
    turns = np.exp(-2j * math.pi * np.outer(frequencies, np.arange(8000)) * PERIOD)
    return turns @ np.array(answers)


def test_a_notch_takes_out_its_frequency_and_leaves_what_is_slow():
    gain = response(FilterParameters(first=NotchParameters(180.0, 0.5, 0.05)), [0.0, 1.0, 180.0])
    np.testing.assert_allclose(np.abs(gain), [1.0, 1.0, 0.05], rtol=1e-3)
    # Half a width away, (ω0² − ω²) = 0.5 ω ω0: as much as the denominator's middle term.
    edge = 180.0 * (0.25 + math.sqrt(1.0 + 0.0625))
    warped = math.atan(edge / 180.0 * math.tan(math.pi * 180.0 * PERIOD)) / (math.pi * PERIOD)
    side = response(FilterParameters(first=NotchParameters(180.0, 0.5, 0.0)), [warped])[0]
    assert side == pytest.approx(1.0 / (1.0 - 1j), rel=1e-3) or side == pytest.approx(1.0 / (1.0 + 1j), rel=1e-3)


def test_a_notch_whose_poles_lie_above_its_zeros_costs_less_phase_below_and_gain_above():
    one, skewed = (FilterParameters(first=NotchParameters(180.0, 0.5, 0.0, poles)) for poles in (1.0, 1.4))
    zero, below, at = response(skewed, [0.0, 60.0, 180.0])
    assert zero == pytest.approx(1.0, rel=1e-6) and abs(at) < 1e-6
    assert 0.0 > np.angle(below) > 0.7 * np.angle(response(one, [60.0])[0])
    warped = (math.tan(math.pi * 1.4 * 180.0 * PERIOD) / math.tan(math.pi * 180.0 * PERIOD)) ** 2
    assert abs(response(skewed, [0.5 / PERIOD])[0]) == pytest.approx(warped, rel=1e-6)


def test_a_roll_off_is_a_low_pass_of_second_order():
    gain = response(FilterParameters(roll_off=RollOffParameters(200.0, 0.7)), [0.0, 200.0])
    np.testing.assert_allclose(gain, [1.0, -1j / 1.4], atol=1e-6)


def test_without_filters_nothing_is_filtered_and_with_any_one_something_is():
    assert filters_of(FilterParameters(), PERIOD) == NONE and not NONE.active
    notch, roll_off = NotchParameters(180.0), RollOffParameters(200.0)
    for one in (FilterParameters(notch), FilterParameters(second=notch), FilterParameters(roll_off=roll_off)):
        assert filters_of(one, PERIOD).active
    assert filters_of(FilterParameters(mains=HumParameters(50.0)), PERIOD, (1j,)).active


def test_two_notches_and_a_roll_off_multiply():
    one, two, three = NotchParameters(100.0, 0.4, 0.1), NotchParameters(300.0, 0.2, 0.2), RollOffParameters(400.0)
    alone = [FilterParameters(first=one), FilterParameters(first=two), FilterParameters(roll_off=three)]
    frequencies = np.array([50.0, 120.0, 310.0, 700.0])
    together = response(FilterParameters(one, two, three), frequencies)
    np.testing.assert_allclose(together, np.prod([response(each, frequencies) for each in alone], axis=0), rtol=1e-9)


@pytest.mark.parametrize("law", ["linear", "smc_observer"])
@pytest.mark.parametrize("mains", [50.0, 60.0])
def test_oscillators_take_the_mains_and_its_multiples_out_of_a_stable_loop(law, mains):
    hum = ControlParameters(law=law, filters=FilterParameters(mains=HumParameters(mains, 3)))
    plain, with_oscillators = (make_law(one, STAGE) for one in (ControlParameters(law=law), hum))
    assert np.abs(loop_margins(with_oscillators, STAGE).poles).max() < 1.0
    responses = (loop_response(one, STAGE, mains * np.arange(1, 4)) for one in (plain, with_oscillators))
    before, after = (np.abs(one.plant * one.sensitivity) for one in responses)
    assert (after < 0.1 * before).all()


def test_an_oscillator_adapts_as_fast_as_its_width_says():
    hum = ControlParameters(filters=FilterParameters(mains=HumParameters(50.0, 1, width=2.0)))
    plant = sampled_plant(STAGE)
    poles = np.linalg.eigvals(closed_loop(plant, linearised(make_law(hum, STAGE))))
    nearest = poles[np.abs(poles - np.exp(2j * math.pi * 50.0 * PERIOD)).argmin()]
    assert -math.log(abs(nearest)) / PERIOD == pytest.approx(2.0 * math.pi * 2.0, rel=0.15)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_gain_of_an_oscillator_moves_its_pole_straight_inward_by_its_width_from_where_a_leak_leaves_it(number):
    filters = FilterParameters(mains=HumParameters(60.0, 3, width=2.0))
    gains = [0j] * number + [3.0 - 0.5j]
    turn = complex(*filters_of(filters, PERIOD, tuple(gains))[4 + number][:2])
    # It forgets a fiftieth as fast as the width says.
    rate = complex(-2.0 * math.pi * 0.02 * 2.0, 2.0 * math.pi * 60.0 * (number + 1))
    assert turn == pytest.approx(np.exp(rate * PERIOD), rel=1e-12)
    moved, tried = 0.3 * np.exp(2j), 1e-3
    gain = turned_gain(filters, number, PERIOD, tried, turn * (1.0 + moved * tried))
    assert moved * gain == pytest.approx(-2.0 * math.pi * 2.0 * PERIOD, rel=1e-9)


def test_the_sampled_plant_has_the_response_of_its_modes():
    mode, frequency = ModeParameters(180.0, 0.02, 0.5, -1.5), 150.0
    z = np.array([np.exp(2j * math.pi * frequency * PERIOD)])

    def at(stage):
        plant: StateSpace = sampled_plant(stage, 0.0)
        return plant.c[0] @ np.linalg.solve(z * np.eye(len(plant.a)) - plant.a, plant.b[:, 0])

    s, w = 2j * math.pi * frequency, 2.0 * math.pi * 180.0
    mass, k = STAGE.platform.mass, STAGE.actuator.position_stiffness
    # The magnets pull where the coils are: from force to y_coil and y_encoder, with that pull fed back.
    to_coil, to_encoder = (1.0 / s**2 + 0.5 * p / (s**2 + 0.04 * w * s + w**2) for p in (0.5, -1.5))
    expected = (to_encoder / (mass - k * to_coil)) / (1.0 / s**2 / (mass - k / s**2))
    # Both are held alike; between them only what the modes fold back differs.
    assert at(STAGE.with_modes(mode)) / at(STAGE) == pytest.approx(expected, rel=0.1)


def test_gains_that_excite_a_described_mode_are_refused_and_a_notch_admits_them():
    stage = STAGE.with_modes(ModeParameters(350.0, 0.01, 1.0 / 3.0, 1.0 / 3.0))
    refused = missing_margin(ControlParameters(), stage)
    assert refused is not None and "unstable" in refused
    notched = FilterParameters(first=NotchParameters(350.0, 0.5, 0.02))
    law = make_law(ControlParameters(filters=notched), stage)
    for machine in with_modes_off(stage).values():
        assert spectral_radius(closed_loop(sampled_plant(machine), linearised(law))) < 1.0


def test_a_mode_that_a_notch_no_longer_meets_at_the_end_of_its_uncertainty_is_a_reason_of_its_own():
    notched = ControlParameters(filters=FilterParameters(first=NotchParameters(350.0, 0.2, 0.02)))
    refused = []
    for error in (0.01, 0.25):
        mode = ModeParameters(350.0, 0.01, 1.0 / 3.0, 1.0 / 3.0, frequency_error=error)
        refused.append(missing_margin(notched, STAGE.with_modes(mode)))
    assert refused[0] is None and "unstable with the platform's modes at" in refused[1]


def test_modes_are_off_to_all_sides_of_their_uncertainty():
    mode = ModeParameters(200.0, 0.02, frequency_error=0.1, damping_factor=2.0, participation_error=0.5)
    machines = with_modes_off(STAGE.with_modes(mode))
    assert list(machines) == ["180 Hz", "200 Hz", "220 Hz"]
    assert {one.platform.modes.first.damping for one in machines.values()} == {0.01}
    assert {one.platform.modes.first.residue for one in machines.values()} == {1.5}
    assert not with_modes_off(STAGE)
