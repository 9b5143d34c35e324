"""Friction beyond plain LuGre: what it must dissipate, remember, and become in its limits."""

import dataclasses
import math

import numpy as np
import pytest
from contact import CHANGES, KINDS, SLIP, UNDAMPED, Contact, plant_with, run, spring_force
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.friction import (
    AGE,
    BLOCK,
    KIND,
    MOST_BLOCKS,
    PLAIN,
    SLIPPING,
    TIME,
    LuGreParameters,
    MaxwellSlipParameters,
    block_after,
    bristle_after,
    friction_force,
    stribeck_force,
)
from straightcomp_ros.model.plant import (
    BIAS,
    Hold,
    Plant,
    PlantParameters,
    PlantState,
    advance,
    advance_to_sample,
    as_array,
    commanded_plant,
)
from straightcomp_ros.parameters.declaration import ParameterError


def test_the_shipped_parameters_are_plain_lugre():
    constants = as_array(PlantParameters().constants())
    assert constants[KIND] == PLAIN and not constants[KIND:].any()
    state = run({}, PlantState(velocity=1e-4, bias=1.0), 0.02, 10)[-1]
    assert not state[TIME:].any()


def test_plain_friction_reads_the_first_seven_fields_only():
    short = np.array(PlantState(velocity=1e-4, bias=1.0))[:7].copy()
    advance(as_array(PlantParameters().constants()), short, 1.0, 0.02, 5_000_000)
    np.testing.assert_array_equal(short, run({}, PlantState(velocity=1e-4, bias=1.0), 0.02, 10)[-1][:7])


@pytest.mark.parametrize("values", KINDS)
def test_a_platform_that_slides_to_rest_only_loses_energy(values):
    plant = plant_with(values)
    states = run(values, PlantState(velocity=1e-2), 0.0, 400, bias=0.0)
    contact = Contact(values)
    last = 0.5 * plant.platform.mass * 1e-4
    for state in states:
        contact.state = state
        now = 0.5 * plant.platform.mass * state[1] ** 2 + contact.stored()
        assert now <= last * (1 + 1e-9)
        last = now
    assert abs(states[-1, 1]) < 1e-4


@pytest.mark.parametrize("values", KINDS)
@given(motion=st.lists(st.floats(-2e-3, 2e-3), min_size=5, max_size=80))
def test_springs_never_store_more_than_the_motion_supplied(values, motion):
    # The work on the bristles or blocks alone, by the mean of their force before and after each step.
    contact = Contact({**values, **UNDAMPED})
    for velocity in motion:
        before, stored = spring_force(contact), contact.stored()
        contact.move(velocity, 5e-5)
        work = 0.5 * (before + spring_force(contact)) * velocity * 5e-5
        if contact.parameters.contact.model == "maxwell_slip":
            assert contact.stored() - stored <= work + 1e-18 + 1e-12 * stored
        else:
            # An exact step of the bristle: the trapezium is not the integral, the largest force bounds it.
            most = max(before * velocity, spring_force(contact) * velocity) * 5e-5
            assert contact.stored() - stored <= most + 1e-18


@pytest.mark.parametrize("values", KINDS)
def test_a_closed_cycle_of_motion_costs_work(values):
    contact = Contact({**values, **UNDAMPED})
    works = []
    for _ in range(3):
        work = 0.0
        for phase in np.arange(2000) * (2 * math.pi / 2000):
            velocity = 5e-5 * math.cos(phase)
            before = spring_force(contact)
            contact.move(velocity, 5e-5)
            work += 0.5 * (before + spring_force(contact)) * velocity * 5e-5
        works.append(work)
    assert min(works) > 0.0


def test_one_block_of_infinite_attraction_is_a_spring_that_slips_at_its_limit():
    # Prandtl's element: F after a step is F + k·d, held within ± the limit.
    random, force, expected, slipping = np.random.default_rng(1), 0.0, 0.0, False
    for velocity in random.normal(0.0, 1e-3, 500):
        force, slipping = block_after(force, slipping, 1e6, 0.5, 0.0, velocity, 1e-4)
        expected = min(max(expected + 1e6 * velocity * 1e-4, -0.5), 0.5)
        assert force == pytest.approx(expected, abs=1e-12)


def test_one_stiff_block_of_infinite_attraction_is_coulomb_friction():
    values = {
        **SLIP,
        **UNDAMPED,
        "friction.static": 0.43,
        "friction.bristle_stiffness": 1e10,
        "contact.maxwell_slip.blocks": 1,
        "contact.maxwell_slip.attraction": 1e12,
    }
    contact = Contact(values)
    for velocity in (1e-3, 2e-2, -1e-3, -1e-5, 1e-5):
        assert contact.move(velocity, 1e-3) == pytest.approx(math.copysign(0.43, velocity))


@pytest.mark.parametrize("velocity", [1e-6, 2e-5, 1e-2, -3e-5])
@pytest.mark.parametrize("limit_spread", [0.2, 1.0, 5.0])
def test_sliding_long_enough_gives_the_stribeck_curve_plus_viscous_friction(velocity, limit_spread):
    contact = Contact({**SLIP, "contact.maxwell_slip.limit_spread": limit_spread})
    for _ in range(200):
        force = contact.move(velocity, 0.1)
    lugre = contact.plant.lugre
    assert force == pytest.approx(math.copysign(stribeck_force(lugre, velocity), velocity) + lugre.viscous * velocity)


def test_before_sliding_the_blocks_are_a_spring_of_the_bristles_stiffness():
    contact = Contact({**SLIP, **UNDAMPED})
    assert contact.move(1e-3, 1e-6) == pytest.approx(1e6 * 1e-9)


def test_friction_lags_a_falling_speed():
    # At the same speed, friction is lower on the way down than on the way up: the frictional lag.
    contact = Contact({**SLIP, **UNDAMPED, "contact.maxwell_slip.attraction": 20.0})
    contact.go(2e-5, 2e-5)
    speeds = np.linspace(5e-6, 6e-5, 300)
    up = [contact.move(v, 2e-4) for v in speeds]
    down = [contact.move(v, 2e-4) for v in speeds[::-1]][::-1]
    assert up[150] > down[150] + 0.005


def test_an_inner_loop_closes_and_leaves_no_trace():
    # Return-point memory: after an excursion to and fro within presliding, the outer branch goes on as without it.
    values = {**SLIP, **UNDAMPED, "contact.maxwell_slip.blocks": 8, "friction.static": 0.43}
    plain, looped = Contact(values), Contact(values)
    for contact in (plain, looped):
        contact.go(4e-7)
    at_turn = looped.force
    looped.go(-2e-7)
    assert looped.force < at_turn - 0.05
    looped.go(1e-7)
    looped.go(-1e-7)
    looped.go(2e-7)
    assert looped.force == pytest.approx(at_turn, abs=1e-9)
    np.testing.assert_allclose(looped.go(4e-7), plain.go(4e-7), atol=1e-9)


def test_the_branch_after_a_reversal_is_the_virgin_curve_of_twice_the_size():
    # Masing's rule holds for blocks that have all begun from zero.
    values = {**SLIP, **UNDAMPED, "friction.static": 0.43}
    contact = Contact(values)
    virgin = np.array(contact.go(5e-7, steps=100))
    back = np.array(contact.go(-1e-6, steps=100))
    np.testing.assert_allclose(virgin[-1] - back, 2 * virgin, atol=1e-9)


def test_lugre_has_no_return_point_memory():
    # What the blocks are for: LuGre's bristle drifts in an inner loop, so that the test above is not empty.
    bristle, lugre = 0.0, LuGreParameters(static=0.43).constants()
    bristle = bristle_after(lugre, bristle, 1e-5, 0.04)
    turn = bristle
    bristle = bristle_after(lugre, bristle, -1e-5, 0.02)
    bristle = bristle_after(lugre, bristle, 1e-5, 0.02)
    assert abs(friction_force(lugre, bristle, 0.0) - friction_force(lugre, turn, 0.0)) > 1e-3


def test_a_motion_cut_into_more_steps_gives_the_same_blocks():
    coarse, fine = (Contact({**SLIP, "contact.maxwell_slip.attraction": 1e3}) for _ in range(2))
    for distance in (1e-6, -4e-7, 9e-7, -3e-6):
        coarse.go(distance, steps=7)
        fine.go(distance, steps=70)
        np.testing.assert_allclose(fine.state[BLOCK:], coarse.state[BLOCK:], atol=1e-9)
        assert fine.state[SLIPPING] == coarse.state[SLIPPING]


def test_blocks_share_stiffness_and_limit():
    parameters = MaxwellSlipParameters(blocks=5, distance_spread=20.0, limit_spread=3.0)
    springs, shares = parameters.stiffnesses_and_shares(2e6)
    assert springs.sum() == pytest.approx(2e6) and shares.sum() == pytest.approx(1.0)
    assert shares[-1] / shares[0] == pytest.approx(3.0)
    distances = shares / springs
    assert distances[-1] / distances[0] == pytest.approx(20.0)


def test_the_machine_code_is_the_python_code():
    values = {**SLIP, **CHANGES}
    constants = as_array(plant_with(values).constants())
    compiled, plain = (np.array(PlantState(velocity=3e-4, bias=1.0)) for _ in range(2))
    for command in (0.02, -0.05, 0.05, -0.02):
        advance(constants, compiled, 1.0, command, 10_000_000)
        advance.__wrapped__(constants, plain, 1.0, command, 10_000_000)
    np.testing.assert_allclose(compiled, plain, rtol=1e-6, atol=1e-15)


def test_the_same_parameters_give_the_same_bits():
    values = {**SLIP, **CHANGES}
    first, second = (run(values, PlantState(velocity=1e-4, bias=1.0), 0.03, 50) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    other = run({**values, "contact.bands.seed": 8}, PlantState(velocity=1e-4, bias=1.0), 0.03, 50)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("values", KINDS)
def test_the_board_moves_the_same_plant(values):
    plant = plant_with(values)
    hold = Hold(after_ns=625_000, weight=0.1, kept=0.6, braking=0.5, stiffness=7000.0)
    board, alone = commanded_plant(plant, hold, PlantState(y=2e-6)), np.array(PlantState(y=2e-6))
    board.state[BIAS] = 1.0
    current = round(0.1 / plant.drive.current_step) * plant.drive.current_step
    for k in range(100):
        begin = k * 500_000
        advance_to_sample(*board, np.array([begin]), np.array([0.1]), 1, begin + 500_000, 0.0)
        advance(as_array(plant.constants()), alone, 1.0, 0.0, 0, current, 500_000)
    np.testing.assert_array_equal(board.state[: alone.size], alone)
    assert board.state[TIME] == pytest.approx(0.05) and board.state[AGE] > 0.0


def test_the_plant_with_blocks_sticks_and_breaks_away():
    stuck = run(SLIP, PlantState(y=1e-6, bias=1.0), 0.0, 1000)
    assert abs(stuck[-1, 1]) < 1e-7 and abs(stuck[-1, 0] - 1e-6) < 1e-7
    current = 1.5 * 0.645 / PlantParameters().actuator.current_stiffness
    assert run(SLIP, PlantState(bias=1.0), current, 200)[-1, 0] > 1e-5


def test_places_in_the_constants_are_those_of_the_parameters():
    plant = plant_with({**SLIP, **CHANGES, "contact.maxwell_slip.blocks": 8, "friction.bristle_stiffness": 2e6})
    constants = plant.constants()
    extension = constants.extension
    assert isinstance(constants, Plant) and len(extension) == 12 + 2 * MOST_BLOCKS
    expected = [2.0, 100.0, 8.0, 0.3, 2e-6, 7.0, 0.2, 1.0, 2.0, 5e-6, 1.7, 0.02]
    assert list(extension[:12]) == expected
    assert sum(extension[12:20]) == pytest.approx(2e6) and sum(extension[20:]) == pytest.approx(1.0)
    assert dataclasses.replace(plant.contact, model="lugre").extension(2e6)[0] == 1.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("model", "dahl"),
        ("maxwell_slip.blocks", 9),
        ("maxwell_slip.attraction", 0.0),
        ("bands.fraction", 1.0),
        ("rest.largest", 0.5),
        ("step.factor", 0.0),
    ],
)
def test_a_value_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(ParameterError, match=f"contact.{name}"):
        plant_with({f"contact.{name}": value})
