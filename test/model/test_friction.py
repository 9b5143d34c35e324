"""Friction: what it must dissipate, remember, and become in its limits; how it changes with place, rest and time."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model import friction
from straightcomp_ros.model.modes import MODE_STATE
from straightcomp_ros.model.plant import (
    BIAS,
    Hold,
    PlantParameters,
    advance,
    advance_to_sample,
    commanded_plant,
    plant_state,
)
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters, TruthParameters, true_plant

STEP = 25e-6
CHANGES = {
    "contact.bands.fraction": 0.3,
    "contact.bands.seed": 7,
    "contact.rest.growth": 0.2,
    "contact.step.factor": 1.7,
    "contact.step.time": 0.02,
}
SLIP = {"contact.model": "maxwell_slip"}
UNDAMPED = {"friction.bristle_damping": 0.0, "friction.viscous": 0.0}
KINDS = [SLIP, CHANGES, {**SLIP, **CHANGES}, {**SLIP, "contact.maxwell_slip.attraction": 1e9}]


def plant_with(values):
    """The simulated machine with these values of ``contact.…``; all others are of its description."""
    contact = {name: value for name, value in values.items() if name.startswith("contact.")}
    described = {name: value for name, value in values.items() if name not in contact}
    return true_plant(from_mapping(StageParameters, described), from_mapping(TruthParameters, contact))


class Contact:
    """Friction alone, moved as the test says; the functions that the plant calls, as plain Python."""

    def __init__(self, values):
        self.parameters = plant_with(values)
        self.lugre, self.constants = self.parameters.friction.constants(), self.parameters.constants()
        self.state = plant_state()
        self.place, self.force = 0.0, 0.0

    def move(self, velocity, duration=STEP):
        """Friction after a step at constant velocity."""
        self.place += velocity * duration
        lugre = friction.lugre_now(self.constants, self.lugre, self.state, self.place)
        friction.step_friction(self.constants, lugre, self.state, velocity, duration)
        self.force = friction.extended_force(self.constants, lugre, self.state, velocity)
        return self.force

    def go(self, distance, speed=1e-5, steps=200):
        """Forces on a way of this length with this sign."""
        duration = abs(distance) / speed / steps
        return [self.move(math.copysign(speed, distance), duration) for _ in range(steps)]

    def stored(self):
        """Energy in the springs, J."""
        if self.parameters.contact.model == "lugre":
            return 0.5 * self.lugre.bristle_stiffness * float(self.state[2]) ** 2
        count = self.parameters.contact.maxwell_slip.blocks
        blocks = self.state[friction.BLOCK : friction.BLOCK + count]
        springs = np.array(self.constants[friction.KIND + 12 :][:count])
        return float(0.5 * np.sum(blocks**2 / springs))


def run(values, start, command, samples, bias=1.0):
    """States after each half millisecond, (samples, fields)."""
    constants, state = plant_with(values).constants(), np.array(start)
    states = []
    for _ in range(samples):
        advance(constants, state, bias, command, 500_000)
        states.append(state.copy())
    return np.array(states)


def spring_force(contact):
    if contact.parameters.contact.model == "lugre":
        return contact.lugre.bristle_stiffness * float(contact.state[2])
    return float(contact.state[friction.BLOCK : friction.BLOCK + friction.MOST_BLOCKS].sum())


LUGRE = friction.LuGreParameters().constants()


def test_the_stribeck_curve_falls_from_static_to_coulomb_friction():
    curve = [friction.stribeck_force(LUGRE, v) for v in np.linspace(0, 1e-4, 50)]
    assert curve[0] == LUGRE.static and curve == sorted(curve, reverse=True)
    assert friction.stribeck_force(LUGRE, 1.0) == pytest.approx(LUGRE.coulomb)


@given(st.floats(-1.0, 1.0), st.floats(0, 1.0))
def test_bristles_never_deflect_beyond_break_away_and_two_half_steps_are_a_whole_one(velocity, duration):
    limit = LUGRE.static / LUGRE.bristle_stiffness
    whole = friction.bristle_after(LUGRE, 0.9 * limit, velocity, duration)
    half = friction.bristle_after(LUGRE, 0.9 * limit, velocity, duration / 2)
    assert abs(whole) <= limit * (1 + 1e-12)
    assert friction.bristle_after(LUGRE, half, velocity, duration / 2) == pytest.approx(whole, rel=1e-9, abs=1e-18)


def test_static_friction_is_no_less_than_coulomb_friction_and_none_without_it():
    with pytest.raises(ParameterError, match=r"static.*0\.5.*>= 0\.6"):
        friction.LuGreParameters(coulomb=0.6, static=0.5)
    with pytest.raises(ParameterError, match=r"static.*allowed: 0 N"):
        friction.LuGreParameters(coulomb=0.0)


@pytest.mark.parametrize(
    ("nothing", "model", "rtol"),
    [
        ({"contact.bands.width": 1e-5, "contact.bands.seed": 3}, {}, 0.0),
        ({"contact.step.time": 0.01, "contact.rest.time": 2.0}, {}, 0.0),
        ({"contact.maxwell_slip.blocks": 8}, {}, 0.0),
        ({"contact.step.factor": 3.0, "contact.step.time": 1.0}, {}, 1e-12),
        ({"contact.bands.fraction": 1e-12}, {}, 1e-6),
        ({"contact.bands.fraction": 1e-12}, SLIP, 1e-6),
    ],
)
def test_changes_of_no_size_or_that_have_not_come_change_nothing(nothing, model, rtol):
    start = plant_state(velocity=1e-4, bias=1.0)
    changed, plain = run({**model, **nothing}, start, 0.02, 20), run(model, start, 0.02, 20)
    np.testing.assert_allclose(changed[:, :7], plain[:, :7], rtol=rtol)


def test_bands_vary_up_to_the_fraction_smoothly_and_by_the_seed_alone():
    def factors(seed):
        return np.array([friction.band_factor(0.3, 2e-6, seed, y) for y in np.linspace(-1e-4, 1e-4, 20001).tolist()])

    found = factors(5)
    assert 0.7 <= found.min() < 0.75 and 1.25 < found.max() <= 1.3
    # Slope of the cubic: 1.5 times the largest change over the band's width.
    assert np.abs(np.diff(found)).max() <= 1.5 * 0.6 * 1e-8 / 2e-6 * (1 + 1e-6)
    assert found.tolist() == factors(5).tolist() != factors(6).tolist()


def test_values_of_the_bands_are_spread_evenly_and_are_the_same_on_every_machine():
    values = np.array([friction.band_value(1, band) for band in range(-5000, 5000)])
    assert np.abs(values).max() <= 1.0
    assert values.mean() == pytest.approx(0.0, abs=0.03) and values.var() == pytest.approx(1 / 3, rel=0.05)
    assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.05
    # Those of every release: a seed names a pattern.
    found = [friction.band_value(*one) for one in ((0, 1), (7, -3), (1_000_000, 2**40))]
    assert found == pytest.approx([-0.9422265179, -0.2588725983, -0.7679979912], abs=1e-9)


@pytest.mark.parametrize(
    ("values", "changes"),
    [
        ({}, False),
        ({"contact.bands.width": 1e-5, "contact.rest.largest": 3.0, "contact.step.time": 2.0}, False),
        *(({name: value}, True) for name, value in (("contact.bands.fraction", 0.1), ("contact.rest.growth", 0.1))),
        *(({"contact.step.factor": factor}, True) for factor in (0.9, 1.1)),
    ],
)
def test_friction_changes_where_one_thing_changes_it(values, changes):
    assert friction.changes(plant_with(values | SLIP).constants()) is changes
    assert plant_with(values).constants()[friction.KIND] == (friction.CHANGING_LUGRE if changes else friction.PLAIN)


def test_sliding_force_follows_the_bands():
    bands = {"contact.bands.fraction": 0.3, "contact.bands.width": 3e-6, "contact.bands.seed": 7}
    contact = Contact({**SLIP, **UNDAMPED, **bands, "contact.maxwell_slip.attraction": 1e9})
    contact.go(1e-5, 1e-3)
    for _ in range(500):
        force = contact.move(1e-3)
        assert force == pytest.approx(0.43 * friction.band_factor(0.3, 3e-6, 7, contact.place), rel=0.05)


def test_age_is_the_time_at_rest_and_sliding_renews_the_contact():
    def after(age, velocity, duration):
        return friction.age_after(age, velocity, duration, 5e-6)

    assert after(2.0, 0.0, 3.0) == 5.0 and after(100.0, 1e-3, 1.0) == pytest.approx(5e-6 / 1e-3)
    assert after(after(2.0, 1e-6, 0.5), 1e-6, 0.5) == pytest.approx(after(2.0, 1e-6, 1.0))
    assert after(2.0, 1e-17, 3.0) == pytest.approx(after(2.0, 1e-14, 3.0), rel=1e-6)
    # Static friction grows with the logarithm of that time, up to its bound.
    for age, factor in ((0.0, 1.0), (3.0 * (math.e - 1.0), 1.1), (1e9, 2.0)):
        contact = Contact({"contact.rest.growth": 0.1, "contact.rest.time": 3.0})
        contact.state[friction.AGE] = age
        rise = friction.lugre_now(contact.constants, LUGRE, contact.state, 0.0).static - LUGRE.coulomb
        assert rise == pytest.approx(factor * (LUGRE.static - LUGRE.coulomb))


@pytest.mark.parametrize("model", ["lugre", "maxwell_slip"])
def test_break_away_grows_with_rest_and_a_step_multiplies_the_sliding_force_from_its_time_on(model):
    def contact(**values):
        contact = {f"contact.{name.replace('_', '.')}": value for name, value in values.items()}
        return Contact({**UNDAMPED, "contact.model": model, **contact})

    peaks = []
    for rest in (0.0, 1.0, 10.0, 1e9):
        rested = contact(rest_growth=0.2)
        rested.move(0.0, rest)
        peaks.append(max(rested.go(1e-5, 2e-6, 2000)))
    assert peaks == sorted(set(peaks)) and 0.75 < peaks[-1] <= 0.43 + 2.0 * (0.645 - 0.43)
    stepped = contact(step_factor=2.0, step_time=0.1)
    forces = [stepped.move(1e-2) for _ in range(8000)]
    assert forces[3900] == pytest.approx(0.43, rel=1e-3) and forces[-1] == pytest.approx(0.86, rel=1e-3)


def test_the_shipped_parameters_are_plain_lugre_which_needs_the_first_seven_fields_only():
    constants = PlantParameters().constants()
    assert constants[friction.KIND] == friction.PLAIN and not constants[friction.KIND : 40].any()
    state = run({}, plant_state(velocity=1e-4, bias=1.0), 0.02, 10)[-1]
    short = plant_state(velocity=1e-4, bias=1.0)[:7].copy()
    advance(constants, short, 1.0, 0.02, 5_000_000)
    assert not state[friction.TIME :].any() and state[:7].tolist() == short.tolist()


@pytest.mark.parametrize("values", [{}, *KINDS])
def test_a_platform_that_slides_to_rest_only_loses_energy(values):
    contact, energies = Contact(values), [0.5 * PlantParameters().platform.mass * 1e-4]
    for state in run(values, plant_state(velocity=1e-2), 0.0, 400, bias=0.0):
        contact.state = state
        energies.append(0.5 * contact.parameters.platform.mass * state[1] ** 2 + contact.stored())
    assert all(now <= last * (1 + 1e-9) for last, now in itertools.pairwise(energies))
    assert abs(state[1]) < 1e-4


@pytest.mark.parametrize("values", KINDS)
@given(motion=st.lists(st.floats(-2e-3, 2e-3), min_size=5, max_size=80))
def test_springs_never_store_more_than_the_motion_supplied(values, motion):
    contact = Contact({**values, **UNDAMPED})
    bristles = contact.parameters.contact.model == "lugre"
    for velocity in motion:
        before, stored = spring_force(contact), contact.stored()
        contact.move(velocity, 5e-5)
        after = spring_force(contact)
        # Of the bristle's exact step the trapezium is not the integral: the largest force bounds it.
        work = max(before * velocity, after * velocity) if bristles else 0.5 * (before + after) * velocity
        assert contact.stored() - stored <= work * 5e-5 + 1e-18 + 1e-12 * stored


def test_one_block_of_infinite_attraction_is_a_spring_that_slips_at_its_limit():
    # Prandtl's element: F after a step is F + k·d, held within ± the limit.
    random, force, expected, slipping = np.random.default_rng(1), 0.0, 0.0, False
    for velocity in random.normal(0.0, 1e-3, 500):
        force, slipping = friction.block_after(force, slipping, 1e6, 0.5, 0.0, velocity, 1e-4)
        expected = min(max(expected + 1e6 * velocity * 1e-4, -0.5), 0.5)
        assert force == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("velocity", [1e-6, 5e-6, 2e-5, 1e-2, -3e-5])
@pytest.mark.parametrize(
    "values",
    [
        {"contact.step.factor": 2.0, "contact.step.time": 1e9},
        *({**SLIP, "contact.maxwell_slip.limit_spread": spread} for spread in (0.2, 1.0, 5.0)),
        *({**kind, "friction.coulomb": 0.0, "friction.static": 0.0} for kind in KINDS),
    ],
)
def test_a_contact_that_slides_long_enough_gives_the_stribeck_curve_plus_viscous_friction(values, velocity):
    contact = Contact(values)
    force = [contact.move(velocity, 0.1) for _ in range(200)][-1]
    level = friction.stribeck_force(contact.lugre, velocity)
    assert force == pytest.approx(math.copysign(level, velocity) + contact.lugre.viscous * velocity)
    # Without dry friction its level and the velocity may both be zero.
    assert contact.lugre.static > 0.0 or contact.move(0.0) == 0.0


def test_friction_lags_a_falling_speed():
    # At the same speed, friction is lower on the way down than on the way up: the frictional lag.
    contact = Contact({**SLIP, **UNDAMPED, "contact.maxwell_slip.attraction": 20.0})
    contact.go(2e-5, 2e-5)
    up, down = ([contact.move(v, 2e-4) for v in np.linspace(*ends, 301)] for ends in ((5e-6, 6e-5), (6e-5, 5e-6)))
    assert up[150] > down[150] + 0.005


def test_an_inner_loop_closes_and_leaves_no_trace_and_a_reversal_is_the_virgin_curve_of_twice_the_size():
    # Return-point memory: after an excursion to and fro within presliding, the outer branch goes on as without it.
    values = {**SLIP, **UNDAMPED, "contact.maxwell_slip.blocks": 8, "friction.static": 0.43}
    plain, looped = Contact(values), Contact(values)
    for contact in (plain, looped):
        contact.go(4e-7)
    at_turn = looped.force
    looped.go(-2e-7)
    assert looped.force < at_turn - 0.05
    for distance in (1e-7, -1e-7, 2e-7):
        looped.go(distance)
    assert looped.force == pytest.approx(at_turn, abs=1e-9)
    np.testing.assert_allclose(looped.go(4e-7), plain.go(4e-7), atol=1e-9)
    # Masing's rule holds for blocks that have all begun from zero.
    contact = Contact(values)
    virgin = np.array(contact.go(5e-7, steps=100))
    np.testing.assert_allclose(virgin[-1] - contact.go(-1e-6, steps=100), 2 * virgin, atol=1e-9)


def test_a_motion_cut_into_more_steps_gives_the_same_blocks():
    coarse, fine = (Contact({**SLIP, "contact.maxwell_slip.attraction": 1e3}) for _ in range(2))
    for distance in (1e-6, -4e-7, 9e-7, -3e-6):
        coarse.go(distance, steps=7)
        fine.go(distance, steps=70)
        np.testing.assert_allclose(fine.state[friction.BLOCK :], coarse.state[friction.BLOCK :], atol=1e-9)
        assert fine.state[friction.SLIPPING] == coarse.state[friction.SLIPPING]


def test_blocks_share_stiffness_and_limit():
    contact = {"blocks": 5, "distance_spread": 20.0, "limit_spread": 3.0}
    plant = plant_with({**SLIP, **{f"contact.maxwell_slip.{name}": value for name, value in contact.items()}})
    extension = np.array(plant.contact.extension(2e6))
    springs, shares = extension[12:17], extension[20:25]
    assert springs.sum() == pytest.approx(2e6) and shares.sum() == pytest.approx(1.0)
    assert not extension[17:20].any() and not extension[25:].any()
    assert shares[-1] / shares[0] == pytest.approx(3.0)
    assert (shares / springs)[-1] / (shares / springs)[0] == pytest.approx(20.0)


def test_the_machine_code_is_the_python_code():
    values = {**SLIP, **CHANGES}
    constants = plant_with(values).constants()
    compiled, plain = (plant_state(velocity=3e-4, bias=1.0) for _ in range(2))
    for command in (0.02, -0.05, 0.05, -0.02):
        advance(constants, compiled, 1.0, command, 10_000_000)
        advance.__wrapped__(constants, plain, 1.0, command, 10_000_000)
    np.testing.assert_allclose(compiled, plain, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("values", KINDS)
def test_the_board_moves_the_same_plant(values):
    plant, initial = plant_with(values), plant_state(y=2e-6)
    board, alone = commanded_plant(plant, Hold(625_000, 0.1, 0.6, 0.5, 7000.0), initial), np.array(initial)
    board.state[BIAS] = 1.0
    current = round(0.1 / plant.drive.current_step) * plant.drive.current_step
    for begin in range(0, 50_000_000, 500_000):
        advance_to_sample(*board, np.array([begin]), np.array([0.1]), 1, begin + 500_000, 0.0, 0.0)
        advance(plant.constants(), alone, 1.0, 0.0, 0, current, 500_000)
    np.testing.assert_array_equal(board.state[:MODE_STATE], alone[:MODE_STATE])
    assert board.state[friction.TIME] == pytest.approx(0.05)
    # An age that nothing depends on is not reckoned.
    assert (board.state[friction.AGE] > 0.0) == (plant.contact.rest.growth > 0.0)


@pytest.mark.parametrize("values", [{}, SLIP])
def test_friction_holds_the_platform_against_the_negative_stiffness_until_it_breaks_away(values):
    # 0.03 N of magnetic force, far below break-away: bristles or blocks deflect by F / (σ0 − K_y) and hold.
    actuator, sigma_0 = PlantParameters().actuator, LUGRE.bristle_stiffness
    stuck = run(values, plant_state(y=1e-6, bias=1.0), 0.0, 1000)[-1]
    deflection = actuator.position_stiffness * 1e-6 / (sigma_0 - actuator.position_stiffness)
    assert stuck[0] - 1e-6 == pytest.approx(deflection, rel=0.1) and abs(stuck[1]) < 1e-8
    current = 1.5 * LUGRE.static / actuator.current_stiffness
    assert run(values, plant_state(bias=1.0), current, 200)[-1, 0] > 1e-5
