"""Margins of the sampled loop: its own poles and borders, the textbook, and the continuous plant."""

import dataclasses
import itertools
import re

import numpy as np
import pytest

from straightcomp_ros.control.laws import LAWS, OPEN_LOOP, ControlParameters, ObserverDesign, make_law, states_of
from straightcomp_ros.control.margins import (
    AS_DESCRIBED,
    LEAST_GAINS,
    StateSpace,
    closed_loop,
    friction_damping,
    last_stable,
    linearised,
    loop_margins,
    missing_margin,
    phase_margin,
    sampled_plant,
    unstable_where,
    with_facts_off,
)
from straightcomp_ros.control.sliding_mode import SlidingDesign, closed_loop_poles
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.model.modes import ModeParameters, ModesParameters, at_encoder
from straightcomp_ros.model.plant import advance, plant_state
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters


def on(**facts):
    return from_mapping(StageParameters, facts)


def late(samples):
    return on(**{"drive.delay": samples})


USUAL, STAGE = StageParameters(), late(0.5)
PERIOD = 5e-4


def law(name, **parameters):
    return make_law(ControlParameters(law=name, **parameters), STAGE)


def test_fast_sampling_without_lag_gives_the_continuous_poles_of_the_design():
    stage = dataclasses.replace(STAGE, rate=1_000_000, drive=DriveParameters(bandwidth=1e6, delay=0.0))
    fast = make_law(ControlParameters(law="linear", smc=SlidingDesign(velocity_bandwidth=1e5)), stage)
    poles = loop_margins(fast, stage).poles
    continuous = np.log(poles[np.abs(poles) > 0.99]) / 1e-6
    for pole in closed_loop_poles(SlidingDesign(), stage):
        assert min(abs(continuous - pole)) < 0.01 * abs(pole)


@pytest.mark.parametrize("name", ["linear", "smc", "smc_observer"])
def test_beyond_its_margins_the_loop_is_unstable(name):
    margins = loop_margins(law(name), STAGE)
    plant, controller = sampled_plant(STAGE), linearised(law(name))

    def largest(degrees):
        ways = (np.exp(1j * np.radians(sign * degrees)) for sign in (1.0, -1.0))
        return max(abs(np.linalg.eigvals(closed_loop(plant, controller, way))).max() for way in ways)

    assert largest(0.97 * margins.phase) < 1.0 < largest(1.03 * margins.phase)
    stages = (late(factor * margins.longest_delay / PERIOD) for factor in (0.99, 1.01))
    in_time, too_late = (loop_margins(law(name), stage).poles for stage in stages)
    assert max(abs(in_time)) < 1.0 < max(abs(too_late))


def test_a_loop_that_is_unstable_has_no_margins():
    poles, *margins = loop_margins(law("smc", smc=SlidingDesign(boundary_layer=5e-4)), STAGE)
    assert max(abs(poles)) > 1.0 and margins == [1.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize("delayed", [False, True])
def test_the_phase_margin_of_an_integrator_is_that_of_the_textbook(delayed):
    """L = k/(z − 1), or k/(z (z − 1)): |L| = 1 where 2 sin(ωT/2) = k."""
    k, one = 0.3, np.eye(1)
    integrator = StateSpace(one, k * one, one, 0.0 * one)
    if delayed:
        a, b = np.array([[1.0, k], [0.0, 0.0]]), np.array([[0.0], [1.0]])
        integrator = StateSpace(a, b, np.array([[1.0, 0.0]]), 0.0 * one)
    minus_one = StateSpace(0.0 * one, 0.0 * one, 0.0 * one, -one)
    half = np.degrees(np.arcsin(k / 2.0))
    expected = 90.0 - half - (2.0 * half if delayed else 0.0)
    assert phase_margin(integrator, minus_one, PERIOD) == pytest.approx(expected, abs=0.2)


def test_a_resonance_that_crosses_twice_between_two_frequencies_has_the_phase_margin_of_a_fine_grid():
    ringing = STAGE.with_modes(ModeParameters(180.0, 0.0005, 0.1, 0.1))
    coarse, fine = (phase_margin(sampled_plant(ringing), linearised(law("linear")), PERIOD, n) for n in (400, 100_000))
    # Steps of the resonance's phase.
    assert coarse == pytest.approx(fine, abs=3.5)


def test_while_the_amplifier_is_as_described_the_measured_current_does_not_change_what_force_is_endured():
    made = law("smc_observer", smc_observer=ObserverDesign(delay=1.0))
    plain, measured = (linearised(made, with_current=measured) for measured in (False, True))
    for force in (0.7, 2.0):
        plant = sampled_plant(USUAL)
        # The position's part of the input and of the law's answer to it, not the current's.
        stronger = plant._replace(c=np.array([[force], [1.0]]) * plant.c)
        one, other = (np.abs(np.linalg.eigvals(closed_loop(stronger, linear))).max() for linear in (plain, measured))
        assert one == pytest.approx(other, abs=1e-6)
    margins = [loop_margins(made, USUAL, with_current=with_current).gain_high for with_current in (False, True)]
    assert abs(margins[0] / margins[1] - 1.0) > 0.05


def test_a_law_that_switches_has_no_linearisation():
    with pytest.raises(ValueError, match="no linearisation"):
        linearised(law("smc", smc=SlidingDesign(boundary_layer=0.0)))


@pytest.mark.parametrize("bristles", [2e7, 5e7, 1e9])
def test_a_law_with_a_dither_is_linear_on_any_stage_with_stiction(bristles):
    for bandwidth in range(300, 1000, 25):
        friction = {"friction.bristle_stiffness": bristles, "friction.coulomb": 0.7, "friction.static": 0.72}
        drive = {"drive.delay": 0.8, "drive.bandwidth": float(bandwidth), "actuator.air_gap": 1.66e-3}
        linearised(make_law(ControlParameters(), from_mapping(StageParameters, friction | drive)))


def test_knowing_the_delay_makes_the_observer_tolerate_it():
    observers = (law("smc_observer", smc_observer=ObserverDesign(delay=delay)) for delay in (0.0, 1.0))
    ignorant, knowing = (loop_margins(one, USUAL).phase for one in observers)
    assert knowing > ignorant + 5.0


@pytest.mark.parametrize("delay", [0.0, 2.5e-4, 5e-4, 7.5e-4, 1e-3])
def test_the_sampled_plant_answers_a_constant_current_after_its_delay_as_the_continuous_one(delay):
    plant = sampled_plant(dataclasses.replace(STAGE, drive=DriveParameters(bandwidth=1e5)), delay)
    x = np.zeros((len(plant.b), 1))
    cycles = 40
    for _ in range(cycles):
        x = plant.a @ x + plant.b
    pole = np.sqrt(STAGE.actuator.position_stiffness / STAGE.platform.mass)
    static = STAGE.actuator.current_stiffness / STAGE.actuator.position_stiffness
    acting = cycles * PERIOD - delay - 1.0 / (2 * np.pi * 1e5)
    position, current = (plant.c @ x + plant.d)[:, 0]
    assert current == pytest.approx(1.0)
    assert position == pytest.approx(static * (np.cosh(pole * acting) - 1.0), rel=1e-3)


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_the_sampled_plant_of_a_flexible_platform_on_a_flexure_is_the_simulated_one_for_small_motions(late):
    modes = ModesParameters(ModeParameters(180.0, 0.01, 0.5, -2.0), ModeParameters(600.0, 0.02, 0.3, 0.7))
    platform = dataclasses.replace(STAGE.platform, stiffness=5e4, damping=20.0, modes=modes)
    free = dataclasses.replace(STAGE.friction, static=0.0, coulomb=0.0, viscous=0.0)
    stage = dataclasses.replace(STAGE, platform=platform, friction=free)
    plant, constants, bias = sampled_plant(stage, late * PERIOD), stage.plant.constants(), stage.actuator.bias_current
    x, state, last = np.zeros(len(plant.b)), plant_state(bias=bias), 0.0
    places = []
    for command in 1e-4 * np.random.default_rng(1).standard_normal(200):
        x = plant.a @ x + plant.b[:, 0] * command
        begin = round(late * stage.period_ns)
        advance(constants, state, bias, last, begin, command, stage.period_ns - begin)
        last = command
        places.append(((plant.c @ x)[0], at_encoder(constants, state, 0)))
    linear, seen = np.transpose(places)
    assert linear == pytest.approx(seen, abs=0.005 * np.ptp(seen))


def test_damping_of_the_motion_adds_to_that_of_the_flexure():
    platform = dataclasses.replace(STAGE.platform, modes=ModesParameters(ModeParameters(180.0, 0.01, 0.5, -2.0)))
    less, more = (dataclasses.replace(STAGE, platform=dataclasses.replace(platform, damping=c)) for c in (20.0, 50.0))
    np.testing.assert_allclose(sampled_plant(less, damping=30.0).a, sampled_plant(more).a, rtol=1e-12)


@pytest.mark.parametrize("speed", [3e-6, 3e-5, 3e-4])
def test_friction_damps_as_its_mean_over_a_gaussian_velocity_does(speed):
    friction, v = STAGE.friction, speed * np.linspace(-8.0, 8.0, 100_001)
    often = np.exp(-0.5 * (v / speed) ** 2)
    slow = np.exp(-((v / friction.stribeck_velocity) ** 2))
    force = (friction.coulomb + (friction.static - friction.coulomb) * slow) * np.sign(v) + friction.viscous * v
    expected = np.sum(often * v * force) / np.sum(often * v * v)
    assert friction_damping(friction, speed) == pytest.approx(expected, rel=1e-5)


def test_the_border_of_stability_is_the_one_next_to_the_stable_value():
    # From 0 to 99 in steps of 1, the first of them too; beyond the gap it is stable again.
    assert last_stable(lambda value: not 0.75 < value < 1.5, 0.0, 99.0) == pytest.approx(0.75, abs=1e-9)
    assert last_stable(lambda value: value < 98.25, 0.0, 99.0) == pytest.approx(98.25, abs=1e-9)
    assert last_stable(lambda value: True, 0.0, 99.0) == 99.0


@pytest.mark.parametrize(
    ("control", "stage"),
    [
        *((ControlParameters(law=law), {}) for law in (*LAWS, OPEN_LOOP)),
        # Its delay is known better than that of the stage that is refused below.
        (ControlParameters(), {"rate": 1000, "uncertainty.longest_delay": 1.2}),
        # A law that switches at rest has no linear margins to miss.
        (ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=0.0)), {"rate": 1000}),
        (ControlParameters(smc_observer=ObserverDesign(stiffening=1.0)), {}),
    ],
)
def test_a_law_that_has_its_margins_is_taken(control, stage):
    assert missing_margin(control, on(**stage)) is None


@pytest.mark.parametrize("law", LAWS)
def test_a_refusal_names_the_group_of_the_law_s_own_gains(law):
    group = re.search(r"'control\.(\w+)\.\*'", missing_margin(ControlParameters(law=law), on(rate=500)))[1]
    assert group == ("smc" if law == "linear" else law)


def test_facts_are_off_to_both_sides_of_their_uncertainty_in_each_combination():
    ranges = {"mass": 0.1, "force": 0.2, "air_gap": 0.15, "amplifier": 2.0, "shortest_delay": 0.8, "longest_delay": 1.5}
    stage = on(**{f"uncertainty.{name}": value for name, value in ranges.items()})
    sides = {"mass": (0.9, 1.1), "force": (0.8, 1.2), "gap": (0.85, 1.15), "amplifier": (0.5, 2.0), "delay": (0.8, 1.5)}
    expected = list(itertools.product(*sides.values()))
    found = [
        (
            one.platform.mass / stage.platform.mass,
            one.actuator.pole_area / stage.actuator.pole_area,
            one.actuator.air_gap / stage.actuator.air_gap,
            one.drive.bandwidth / stage.drive.bandwidth,
            one.drive.delay / stage.drive.delay,
        )
        for one in with_facts_off(stage, tuple(sides)).values()
    ]
    assert np.array(found) == pytest.approx(np.array(expected))
    # What is known exactly has one side.
    certain = on(**{"uncertainty.mass": 0.0, "uncertainty.force": 0.0})
    assert list(with_facts_off(certain)) == ["mass × 1, force × 1, gap × 0.9", "mass × 1, force × 1, gap × 1.1"]


def test_a_corner_that_no_machine_can_have_hides_no_other_one():
    for gap in (0.19, 0.21):
        uncertain = on(**{"uncertainty.mass": 0.5, "uncertainty.force": 0.5, "uncertainty.air_gap": gap})
        assert unstable_where(ControlParameters(), uncertain) not in ("", AS_DESCRIBED)
    # The narrowest gap does not hold the stop.
    with pytest.raises(ParameterError):
        with_facts_off(uncertain)


def test_a_law_is_unstable_as_described_or_at_a_corner_or_nowhere():
    switching = ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=0.0))
    assert unstable_where(ControlParameters(law="linear"), on(rate=200)) == AS_DESCRIBED
    assert unstable_where(ControlParameters(), USUAL) == unstable_where(switching, on(rate=200)) == ""
    assert unstable_where(ControlParameters(law=OPEN_LOOP), USUAL) == ""


SHARP = ControlParameters(law="smc", smc=SlidingDesign(boundary_layer=2e-3))


def test_a_refusal_names_what_is_missed_and_the_gain_the_delay_or_the_phase_at_the_border_of_stability(monkeypatch):
    def refused(pattern, control=ControlParameters(), stage=USUAL):  # noqa: B008
        found = re.search(pattern, missing_margin(control, stage))
        return float(found.group(1)), loop_margins(make_law(control, stage), stage)

    sentence = missing_margin(SHARP, USUAL)
    for words in ("'control.smc.*'", "stage 'synthetic'", "2000 Hz", "law 'smc'", ">= 1.25", "straightcomp design"):
        assert words in sentence
    gain, margins = refused(r"stable up to (\S+) times", SHARP)
    assert gain == pytest.approx(margins.gain_high, abs=0.01)
    # Too weak a loop is refused as too strong a one.
    weak = ControlParameters(smc_observer=ObserverDesign(gain_allowance=2.7))
    assert refused(r"stable down to (\S+) times its loop gain", weak)[0] > LEAST_GAINS[0]
    slow = on(rate=1000)
    delay, margins = refused(r"up to (\S+) samples late", stage=slow)
    assert delay == pytest.approx(margins.longest_delay / slow.period, abs=0.01)
    # The gain margins hold.
    monkeypatch.setattr("straightcomp_ros.control.margins.LEAST_PHASE", 40.0)
    phase, margins = refused(r"phase margin of (\S+)°")
    assert phase == pytest.approx(margins.phase, abs=1.0)


def test_a_law_with_a_friction_model_must_be_stable_at_its_stiffest_too():
    control = ControlParameters(smc_observer=ObserverDesign(stiffening=4.0))
    stiff = states_of(control, USUAL)["stiff"]
    assert stiff.smc_observer.bandwidth == pytest.approx(4.0 * control.smc_observer.bandwidth)
    assert ", at its stiffest," in missing_margin(control, USUAL)
    plant, law = sampled_plant(USUAL), linearised(make_law(stiff, USUAL))
    assert max(np.abs(np.linalg.eigvals(closed_loop(plant, law, gain))).max() for gain in (0.9, 1.1)) >= 1.0
