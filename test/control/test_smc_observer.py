"""Law smc_observer: whole strokes, rest, its stiffness, its friction model and the fit of its size."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.law import Law
from straightcomp_ros.control.laws import (
    ControlParameters,
    ObserverDesign,
    can_hold,
    described_state,
    dither_of,
    make_law,
    needs_dither,
    states_of,
)
from straightcomp_ros.control.margins import closed_loop, linearised, sampled_plant, spectral_radius
from straightcomp_ros.control.observer import observer_gains
from straightcomp_ros.control.smc_observer import Lags, Stiffness, _stiffness, fit_at_start, fitted, lagged, step
from straightcomp_ros.model.friction import bristle_after, friction_force
from straightcomp_ros.model.modes import ModeParameters
from straightcomp_ros.model.plant import advance, plant_state
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
T = 5e-4
SETTLE = 0.5


@cache
def stroke(friction, model="lugre", **control):
    """Record and metrics of a stroke whose plant has ``friction`` times the nominal friction."""
    values = shipped_parameters()
    values["controller"].update({f"control.{name}": value for name, value in control.items()})
    for name in ("friction.coulomb", "friction.static"):
        # The machine's alone: the law believes the description.
        values["driver"][f"stage.{name}"] = friction * values["stage"][name]
    values["driver"]["simulated.truth.contact.model"] = model
    values["stage"].update({"drive.delay": 0.5, "motion.stroke": 0.6, "motion.settle": SETTLE, "motion.pause": SETTLE})
    record, straightness = run_stroke(values)
    return record, evaluate(record, straightness)


def law(**design):
    return make_law(ControlParameters(smc_observer=ObserverDesign(**design)), STAGE)


@pytest.mark.no_cover  # whole strokes, which take three times as long under it
@pytest.mark.parametrize("friction", [0.33, 1.0, 2.0])
def test_a_stroke_with_unknown_friction_leaves_little_error_at_small_steps_of_the_current(friction):
    metrics = stroke(friction)[1]
    assert metrics.true_pp < 0.2e-6 and metrics.true_rms < 0.026e-6
    assert metrics.control_rms_step < 5.5e-3


@pytest.mark.no_cover
def test_where_the_friction_model_explains_little_the_law_is_stiffer_and_leaves_less_error():
    def changed(stiffening):
        return stroke(1.0, "maxwell_slip", **{"smc_observer.stiffening": stiffening})[1]

    quiet, stiff = changed(1.0), changed(1.4)
    assert stiff.true_rms < 0.8 * quiet.true_rms
    assert stiff.control_rms_step > 2.0 * quiet.control_rms_step
    # With the model's friction the same stiffening is not used.
    assert stroke(1.0)[1].control_rms_step < 1.1 * stroke(1.0, **{"smc_observer.stiffening": 1.0})[1].control_rms_step


@pytest.mark.parametrize(("misfit", "share"), [(0.0, 0.0), (1.0, 0.0), (1.25, 0.25), (2.0, 1.0), (50.0, 1.0)])
def test_the_law_stiffens_between_one_and_two_tolerated_misfits(misfit, share):
    one = law()
    found = _stiffness(one.gains, 1.0, (misfit * one.gains.misfit) ** 2)
    quiet, stiff = np.array(one.gains.quiet), np.array(one.gains.stiff)
    assert np.array(found) == pytest.approx(quiet + share * (stiff - quiet))
    assert one.gains.stiff.surface == pytest.approx(1.4 * one.gains.quiet.surface)


def test_at_rest_the_command_is_held_and_leaving_rest_makes_no_step():
    record, _ = stroke(1.0)
    steps, start, turn = np.abs(np.diff(record.current)), round(SETTLE / T), round(record.time.size / 2)
    # In the middle of the pause, which begins half of it before.
    assert not steps[start - 200 : start].any() and not steps[turn + 100 : turn + 300].any()
    leaving = steps[start : start + 400]
    assert leaving[leaving > 0.0][0] < 1e-3
    assert leaving.max() <= 1.1 * steps[start + 400 : turn - 400].max()


def held(servo):
    """Commands of 0.2 s at rest, with an encoder that flickers by a count."""
    servo.reset(0.0)
    return [servo.step(1e-7 * (k % 2), 0.0, 0.0, 0.0).current for k in range(400)]


def test_the_held_command_is_the_mean_of_the_last_ones():
    commands, moving = held(law()), np.array(held(law(rest_band=0.0))[100:200])
    assert commands[-150:] == [commands[-1]] * 150
    assert commands[-1] == pytest.approx(moving.mean(), abs=0.5 * moving.std()) and moving.std() > 0.0


@pytest.mark.parametrize(("rest_band", "holds"), [(2.0, True), (0.0, False)])
def test_a_band_of_zero_never_holds_not_even_where_the_reading_is_the_reference(rest_band, holds):
    one = law(rest_band=rest_band)
    state = one.start(0.0)
    for _ in range(300):
        state, _ = one.function(one.gains, state, 0.0, 0.0, 0.0, 0.0, math.nan)
    assert (state.rest.time > one.gains.wait) is holds


@pytest.mark.parametrize(
    ("sample", "held_for", "free_from"),
    [
        (lambda k: (0.3e-6, 0.0, 0.0), 0, 0),
        (lambda k: (-0.3e-6, 0.0, 0.0), 0, 0),
        (lambda k: (0.0, 0.0, 2e-7), 0, 0),
        # By a tenth of a count after 0.2 s; the next hold comes 0.1 s later.
        (lambda k: (1e-7 * (k % 2), 5e-8 * T * k, 5e-8), 390, 410),
        (lambda k: (0.15e-6, 0.0, 0.0), 190, 210),
    ],
    ids=["above the band", "below the band", "moving reference", "creeping reference", "slipped by over a count"],
)
def test_the_hold_ends_where_the_platform_or_its_reference_has_left_its_place(sample, held_for, free_from):
    servo = law()
    command = held(servo)[-1]
    found = [servo.step(*sample(k), 0.0).current for k in range(free_from + 90)]
    assert found[:held_for] == [command] * held_for and command not in found[free_from:]
    error = sample(0)[0] - sample(0)[1]
    # Beyond the band the law acts against the error at once.
    assert held_for or error == 0.0 or (found[0] - command) * error < 0.0


def test_the_friction_model_is_driven_by_the_reference_and_a_share_of_the_observed_velocity():
    one = law(first_size=1.0, velocity_share=0.25)
    state = one.start(0.0)
    state = state._replace(prior=state.prior._replace(velocity=4e-5))
    state, answer = one.function(one.gains, state, 0.0, 0.0, 1e-4, 0.0, math.nan)
    velocity = 0.75 * 1e-4 + 0.25 * answer.velocity_estimate
    assert state.bristle == pytest.approx(bristle_after(one.gains.lugre, 0.0, velocity, T), rel=1e-12)
    friction = friction_force(one.gains.lugre, state.bristle, velocity) / one.gains.loop.mass
    assert answer.disturbance_estimate == pytest.approx(state.prior.disturbance - friction, rel=1e-9)


def test_friction_starts_at_its_first_size_within_the_largest_and_may_be_none():
    assert law(first_size=3.0, largest_size=2.0).start(0.0).fit.size == 2.0
    one = law()
    state = one.start(1e-6)
    state = state._replace(fit=state.fit._replace(size=0.0), bristle=1e-7)
    after, answer = one.function(one.gains, state, 1e-6, 1e-6, 0.0, 0.0, math.nan)
    assert after.bristle == 1e-7 and answer.disturbance_estimate == 0.0


def test_what_friction_takes_over_the_disturbance_gives():
    """Two laws that differ only in the bound of the size: s F̄ and d have the same sum."""
    free, bounded = law(), law(largest_size=0.2)
    state = free.start(0.0)
    for k in range(2000):
        sample = (1e-5 * math.sin(0.02 * k), 5e-6 * math.sin(0.02 * k), 2e-4 * math.cos(0.02 * k), 0.0, 0.0)
        bound, _ = bounded.function(bounded.gains, state, *sample)
        state, _ = free.function(free.gains, state, *sample)
        totals = [each.prior.disturbance + each.fit.size * each.fit.lags.third for each in (state, bound)]
        assert totals[0] == pytest.approx(totals[1], abs=1e-9)
        if state.fit.size > 0.25:
            break
    assert state.fit.size > 0.2 == bound.fit.size


def stage(**facts):
    return from_mapping(StageParameters, {name.replace("__", "."): fact for name, fact in facts.items()})


def following(described, truth, seconds, amplitude=0.0):
    """Errors r − y in m and commands in A, (n,) each, of a platform ``truth`` on a sine of 1 Hz, after 1 s at rest."""
    servo, n = make_law(ControlParameters(), described), round(seconds / T)
    constants, state = truth.plant.constants(), plant_state(y=0.37e-6)
    servo.reset(state[0])
    errors, commands, last = np.empty(n), np.empty(n), 0.0
    for k in range(n):
        angle = 2.0 * math.pi * max(0.0, k * T - 1.0)
        r, speed = amplitude * (1.0 - math.cos(angle)), 2.0 * math.pi * amplitude * math.sin(angle)
        reading = truth.encoder.y_reading(state[0])
        errors[k] = r - state[0]
        commands[k] = servo.step(reading, r, speed, 0.0, float(state[3])).current
        advance(constants, state, 1.0, last, round(5e8 * T), commands[k], round(5e8 * T))
        last = commands[k]
    return errors, commands


NONE = {"friction__coulomb": 0.0, "friction__static": 0.0}


@pytest.mark.parametrize("factor", [0.0, 0.001, 0.04, 1.0])
def test_a_platform_with_any_part_of_the_described_friction_does_not_oscillate_at_rest_or_in_motion(factor):
    truth = stage(friction__coulomb=factor * 0.43, friction__static=factor * 0.645)
    errors, _ = following(STAGE, truth, 2.0, amplitude=5e-6)
    assert np.ptp(errors[1700:2000]) < 0.2e-6 and np.ptp(errors[2400:]) < 0.2e-6


@pytest.mark.parametrize("facts", [NONE, {**NONE, "platform__stiffness": 5e4, "platform__damping": 20.0}])
def test_an_air_bearing_and_a_flexure_are_quiet_when_they_are_described(facts):
    described = stage(**facts)
    errors, commands = following(described, described, 2.0, amplitude=5e-6)
    assert np.ptp(errors[1000:]) < 0.18e-6 and np.diff(commands[1000:]).std() < 4e-3
    # The converter rounds nothing off that the observer does not know.
    assert commands.tolist() == [described.drive.converted(current) for current in commands]


@pytest.mark.parametrize("amplitude", [5e-6, 20e-6])
def test_a_stiffness_that_is_not_as_described_is_known_to_the_slow_observer(amplitude):
    flexure = {**NONE, "platform__stiffness": 5e4, "platform__damping": 20.0}
    truth = stage(**flexure, actuator__air_gap=1.1 * STAGE.actuator.air_gap)
    errors, _ = following(stage(**flexure), truth, 4.0, amplitude)
    assert errors[4000:].std() < max(20e-9, 2.5e-3 * amplitude)


def test_the_law_goes_over_to_its_free_gains_as_friction_vanishes():
    gains = law().gains
    for size in (1e-12, 0.4):
        assert np.array(_stiffness(gains, size * gains.counting, 0.0)) == pytest.approx(gains.free)
    assert np.array(_stiffness(gains, 0.75 * gains.counting, 0.0)) == pytest.approx(gains.slow)
    # Between, each gain goes evenly by factors: from quiet to slow, and from slow to free.
    for size, (one, other, share) in {
        0.9: (gains.quiet, gains.slow, 0.4),
        0.6: (gains.slow, gains.free, 0.6),
    }.items():
        expected = np.exp((1.0 - share) * np.log(one) + share * np.log(other))
        assert np.array(_stiffness(gains, size * gains.counting, 0.0)) == pytest.approx(expected)
    assert gains.slow[:2] == gains.quiet[:2] and gains.slow.third == gains.free.third
    assert _stiffness(gains, gains.counting, 0.0) == gains.quiet
    unexplained = (10.0 * gains.misfit) ** 2
    assert np.array(_stiffness(gains, 1e-12, unexplained)) == pytest.approx(gains.quiet)
    assert _stiffness(gains, gains.counting, unexplained) == gains.stiff


@pytest.mark.parametrize(("variance", "kept"), [(1.0, False), (0.5, True), (0.05, False)])
def test_a_fit_that_a_motion_has_only_begun_is_not_believed(variance, kept):
    one = law()
    state = one.start(0.0)
    state = state._replace(fit=state.fit._replace(size=1e-12, p22=variance), believed=1.0)
    after, _ = step(one.gains, state, 0.0, 0.0, 0.0, 0.0, math.nan)
    assert after.believed == (1.0 if kept else 1e-12)
    # More friction than that is believed at once: the command is that of a fit that is certain.
    state = state._replace(believed=1e-12)
    certain, begun = (state._replace(fit=state.fit._replace(size=1.0, p22=p22)) for p22 in (1e-3, variance))
    commands = [step(one.gains, each, 1e-6, 0.0, 0.0, 0.0, math.nan)[1] for each in (certain, begun)]
    assert commands[0] == commands[1]


@pytest.mark.parametrize("changes", [{}, {"surface": 460.0, "reaching": 520.0, "third_pole": 0.7, "bandwidth": 230.0}])
def test_between_its_gains_the_law_is_as_stable_as_with_the_worse_of_them_on_any_machine(changes):
    control = ControlParameters(smc_observer=replace(ControlParameters().smc_observer, **changes))
    own = make_law(control, STAGE)
    gains = own.gains
    for light in (1.0, 1.25):
        machine = stage(platform__mass=STAGE.platform.mass / light, actuator__turns=STAGE.actuator.turns * light**0.5)
        plant = sampled_plant(machine, 1.4 * STAGE.period)

        def radius(one, plant=plant):
            law = Law(gains._replace(free=one, slow=one, quiet=one, stiff=one), own.start, step, compiled=True)
            return spectral_radius(closed_loop(plant, linearised(law, with_current=True)))

        worst = max(map(radius, (gains.free, gains.slow, gains.quiet, gains.stiff)))
        for size in np.linspace(0.4, 1.0, 13) * gains.counting:
            for misfit in np.linspace(0.0, 4.0, 9) * gains.misfit:
                between = _stiffness(gains, size, misfit**2)
                assert radius(between) <= worst + 2e-3


def test_margins_are_asked_of_each_state_that_the_law_may_take():
    mode = ModeParameters(350.0, 0.01, 0.3, -0.3)
    for rigid, friction, states in (
        (True, STAGE.friction, {"quiet", "stiff", "slow", "free"}),
        (False, STAGE.friction, {"quiet", "stiff"}),
        (True, stage(**NONE).friction, {"quiet", "slow", "free"}),
        (False, stage(**NONE).friction, {"quiet"}),
    ):
        own = STAGE if rigid else STAGE.with_modes(mode)
        described = replace(own, friction=friction, uncertainty=replace(STAGE.uncertainty, friction=100.0))
        assert set(states_of(ControlParameters(), described)) == states
        # Beside a mode the law goes over to no gains whose margins are not asked for.
        gains = make_law(ControlParameters(), described).gains
        assert (gains.free == gains.slow == gains.quiet) is not rigid
    certain = replace(STAGE, uncertainty=replace(STAGE.uncertainty, friction=1.0))
    assert set(states_of(ControlParameters(), certain)) == {"quiet", "stiff"}
    assert set(states_of(ControlParameters(law="linear"), STAGE)) == {"quiet"}


def test_without_enough_friction_the_command_is_not_held():
    assert law().gains.holding < 0.15 and len(set(held(make_law(ControlParameters(), stage(**NONE)))[-100:])) > 1


def test_a_band_that_toggling_prevents_from_being_kept_grows_until_the_command_is_held():
    servo = law()
    servo.reset(0.0)
    fitted_once = servo.start(0.0).fit._replace(size=1.0, p22=0.5)
    state, commands = servo.start(0.0)._replace(fit=fitted_once), []
    for k in range(4000):
        # Six counts to and fro at 29 Hz: three times the band.
        y = 0.6e-6 * (1 if math.sin(2.0 * math.pi * 29.0 * k * T) > 0.0 else -1)
        state, answer = servo.function(servo.gains, state, y, 0.0, 0.0, 0.0, math.nan)
        commands.append(answer.current)
    assert commands[-1500:] == [commands[-1]] * 1500 and len(set(commands[:1000])) > 500


STIFF = {"friction__bristle_stiffness": 1e8, "friction__static": 0.56}


def test_only_a_stage_whose_bristles_hide_within_the_count_gets_a_dither_which_rest_ends():
    assert dither_of(ObserverDesign(), STAGE).amplitude == dither_of(ObserverDesign(), stage(**NONE)).amplitude == 0.0
    stiff = stage(**STIFF)
    angle, amplitude, _ = dither_of(ObserverDesign(), stiff)
    # At a quarter of the rate, and as much as carries F_C through the amplifier's lag, 1.7 times.
    assert angle == pytest.approx(0.5 * math.pi)
    assert amplitude == pytest.approx(1.7 * 0.43 / stiff.actuator.current_stiffness * math.hypot(1.0, 500.0 / 500.0))
    assert dither_of(ObserverDesign(dither=0.0), stiff).amplitude == 0.0
    errors, commands = following(stiff, stiff, 2.0, amplitude=5e-6)
    assert not np.diff(commands[1800:2000]).any() and np.diff(commands[2400:]).std() > amplitude
    # It begins over ten turns of four samples, and the platform is not pushed.
    steps = np.abs(np.diff(commands[2000:]))
    begun = np.flatnonzero(steps)[0]
    assert steps[begun : begun + 7].max() < 0.5 * steps[begun + 60 : begun + 99].max()
    assert np.ptp(errors[2000:]) < 0.2e-6


PULL = STAGE.actuator.position_stiffness * 1e-7
STEP_FORCE = STAGE.actuator.current_stiffness * 2.0 / 4096
DITHERED = 3.0 * (2.0 * math.pi * 500.0) ** 2
"""N at rest by a count and by a converter's step; N/m of the mass at the dither's frequency, a quarter of the rate."""


@pytest.mark.parametrize(
    ("names", "border", "facts"),
    [
        # Bristles that bend by two counts before they slide, or by half of what the usual dither moves the mass.
        ("bristle_stiffness", 0.7 / 2e-7, {"friction__static": 0.7}),
        ("bristle_stiffness", 0.7 / (0.85 * 0.43 / DITHERED), {"friction__static": 0.7, "encoder__y_resolution": 1e-9}),
        # That are a tenth of the mass's own stiffness.
        ("bristle_stiffness", 0.1 * DITHERED, {"encoder__y_resolution": 1e-6}),
        # Friction that is twice what is lost in the quanta.
        ("coulomb static", 2.0 * (PULL + STEP_FORCE), {"friction__bristle_stiffness": 1e8}),
    ],
)
def test_dither_begins_where_bristles_hide_are_stiff_and_count(names, border, facts):
    for factor, needed in ((0.99, False), (1.01, True)):
        given = {f"friction__{name}": factor * border for name in names.split()}
        assert needs_dither(stage(**facts, **given)) is needed


@pytest.mark.parametrize("late", [0.0, 1.0, 2.5])
def test_dither_is_slower_where_commands_are_late(late):
    stiff = stage(**STIFF, drive__delay=late)
    dead_time = (late + 0.5) * T + 1.0 / (2.0 * math.pi * 500.0)
    angle, _, velocity = dither_of(ObserverDesign(), stiff)
    assert angle == pytest.approx(2.0 * math.pi * min(0.25, 0.54 / dead_time * T))
    assert velocity == pytest.approx(1.7 * 0.43 / (3.0 * angle / T))


def test_friction_holds_from_a_count_beside_the_balance_with_half_a_step_of_the_converter_too_much_on():
    for factor, holds in ((0.99, False), (1.01, True)):
        coulomb = factor * (PULL + 0.5 * STEP_FORCE)
        described = stage(friction__coulomb=coulomb, friction__static=coulomb)
        assert can_hold(described) is holds
        gains = make_law(ControlParameters(), described).gains
        assert (gains.holding <= 1.0) is holds
        assert gains.counting * coulomb == pytest.approx(0.5 * (PULL + STEP_FORCE))
    for factor, state in ((0.99, "free"), (1.01, "quiet")):
        coulomb = factor * 0.5 * (PULL + STEP_FORCE)
        name, control = described_state(ControlParameters(), stage(friction__coulomb=coulomb, friction__static=coulomb))
        assert name == state and (control == ControlParameters()) is (state == "quiet")


def test_what_a_law_forgets_it_forgets_by_its_time_constants():
    gains = law(memory=3.0, rest_wait=0.2).gains
    for weight, seconds in (
        (1.0 - gains.kept, 3.0),
        (gains.smooth, 1.0 / (2.0 * math.pi * 60.0)),
        (gains.mean, 0.3),
        (gains.weight, 0.25 * 0.2),
    ):
        assert (1.0 - weight) ** (seconds / T) == pytest.approx(math.exp(-1.0))
    # The magnets' stiffness pulls the mass by 1 m/s² there.
    assert STAGE.actuator.position_stiffness * gains.travel / STAGE.platform.mass == pytest.approx(1.0)


@pytest.mark.parametrize("stiffness", [1e8, 1e9])
def test_on_a_fine_encoder_what_dither_moves_far_beyond_its_bristles_gets_it_and_rests(stiffness):
    fine = {**STIFF, "encoder__y_resolution": 1e-9, "friction__bristle_stiffness": stiffness}
    assert dither_of(ObserverDesign(), stage(**fine)).amplitude > 0.0
    # Half a micrometre is left without.
    errors, commands = following(stage(**fine), stage(**fine), 2.0, amplitude=5e-6)
    assert np.ptp(errors[2000:]) < 0.15e-6
    # Though dither moves the platform by 25 counts.
    assert not np.diff(commands[1850:2000]).any()
    softer = stage(**{**fine, "friction__bristle_stiffness": 1e7})
    assert dither_of(ObserverDesign(), softer).amplitude == 0.0


def test_the_dither_follows_the_friction_that_is_found_within_its_bounds():
    described = stage(**STIFF)
    angle, amplitude, _ = dither_of(ObserverDesign(), described)
    found = []
    for factor in (0.02, 0.4, 0.8, 3.0):
        true = stage(**{**STIFF, "friction__coulomb": factor * 0.43, "friction__static": factor * 0.56})
        commands = following(described, true, 5.0, amplitude=5e-6)[1][6000:]
        found.append(2.0 * abs(np.mean(commands * np.exp(1j * angle * np.arange(commands.size)))) / amplitude)
    # The law answers what the encoder shows of it, too.
    least, less, one, most = found
    assert least < 0.3 * one and less == pytest.approx(0.55 * one, rel=0.1) and one < most < 2.5


@pytest.mark.parametrize("velocity", [-1e-3, -1e-5, 2e-6, 1e-4])
def test_under_dither_friction_is_a_curve_of_the_velocity_without_memory(velocity):
    described, size = stage(**STIFF), 0.5
    one = make_law(ControlParameters(), described)
    state = one.start(0.0)
    state = state._replace(fit=state.fit._replace(size=size), prior=state.prior._replace(velocity=velocity))
    after, answer = one.function(one.gains, state, 0.0, 0.0, velocity, 0.0, math.nan)
    knee, v = dither_of(ObserverDesign(), described).velocity, velocity + 0.3 * (answer.velocity_estimate - velocity)
    force = size * (0.43 / math.hypot(v, knee) + 10.0) * v
    assert answer.disturbance_estimate - after.prior.disturbance == pytest.approx(-force / one.gains.loop.mass)
    assert after.bristle == 0.0


@pytest.mark.parametrize("limit", ["actuator.current_limit", "drive.gain"])
@given(y=st.floats(-2e-3, 2e-3), r=st.floats(-1e-4, 1e-4), rate=st.floats(-1e-3, 1e-3))
def test_every_command_is_finite_and_within_its_limit_wherever_the_platform_is(limit, y, r, rate):
    facts = {"actuator.current_limit": 0.4, "drive.gain": 0.04}
    servo = make_law(ControlParameters(), from_mapping(StageParameters, {limit: facts[limit]}))
    servo.reset(y)
    for reading in (y, -y, 0.0, y):
        command = servo.step(reading, r, rate, 0.0)
        assert math.isfinite(command.current) and abs(command.current) <= 0.4
        assert command.error == r - reading


BANDWIDTH, THIRD = 199.0, 1.28
POLE = math.exp(-2.0 * math.pi * BANDWIDTH * T)
WEIGHTS = Stiffness(*[math.nan] * 5, double=1.0 - POLE, third=1.0 - POLE**THIRD, mass=math.nan)
GAINS = law().gains._replace(kept=math.exp(-T / 2.0), smooth=0.17, mean=T / 0.3, travel=25e-6)


def samples(count):
    """r, ṙ and F̄ of an ever changing motion with a reversing friction of 0.25 m/s²."""
    for k in range(count):
        angle = 2.0 * math.pi * 3.0 * k * T
        yield 1e-5 * math.sin(angle), 1.9e-4 * math.cos(angle), -0.25 * math.tanh(20.0 * math.cos(angle))


START = fit_at_start(0.15)


def fit_after(count, size, *, fit=START, constant=0.0, slope=0.0):
    """The fit to a disturbance of friction of ``size`` and others, with the law taking over what it fits."""
    for r, r_dot, unit in samples(count):
        friction = lagged(WEIGHTS, fit.lags, unit).third
        others = constant + slope * r / GAINS.travel + (size - fit.size) * friction
        fit = fitted(GAINS, WEIGHTS, fit, r, r_dot, unit, others)
    return fit


@pytest.mark.parametrize("third", [0.5, 1.0, THIRD])
def test_the_observers_estimate_of_an_acceleration_has_two_lags_of_its_bandwidth_and_the_third_beside(third):
    gains, weights = np.array(observer_gains(BANDWIDTH, third, T)), WEIGHTS._replace(third=1.0 - POLE**third)
    step = np.array([[1, T, T**2 / 2], [0, 1, T], [0, 0, 1]])
    estimate, plant, lags = np.zeros(3), np.zeros(3), Lags(0.0, 0.0, 0.0, 0.0, 0.0)
    for acceleration in np.random.default_rng(2).uniform(-1.0, 1.0, 200).tolist():
        estimate = estimate + gains * (plant[0] - estimate[0])
        plant[2] = acceleration
        lags = lagged(weights, lags, plant[2])
        assert estimate[2] == pytest.approx(lags.third, abs=1e-9)
        estimate, plant = step @ estimate, step @ plant


@pytest.mark.parametrize(("size", "found"), [(0.3, 0.3), (1.0, 1.0), (3.0, 3.0), (-1.0, 1e-3), (9.0, 4.0)])
def test_the_size_of_friction_is_found_within_its_bounds_with_a_constant_and_an_error_of_stiffness(size, found):
    fit = fit_after(2000, size, constant=0.05, slope=-0.08)
    if found != size:
        assert fit.size == found
    else:
        assert fit.size == pytest.approx(size, rel=0.02)
        assert fit.constant == pytest.approx(0.05, abs=0.005) and fit.slope == pytest.approx(-0.08, abs=0.01)


def test_the_fit_is_recursive_least_squares_with_forgetting():
    """In matrices, for any state: P ← (P − k kᵀ/(λ + φᵀPφ))/λ, and the part that is missing times P φ/(λ + φᵀPφ)."""
    random = np.random.default_rng(1)
    for _ in range(20):
        root, (unit, others, *before) = random.normal(size=(3, 3)), random.normal(0.0, 1.0, 9)
        p, r, lags = 6.0 * root @ root.T, 1e-5 * random.normal(), Lags(*random.normal(0.0, 0.2, 5).tolist())
        c, b, s, misfit, square = before[0], before[1], 1.0 + 0.1 * before[2], before[3], before[4] ** 2
        fit = START._replace(constant=c, slope=b, size=s, misfit=misfit, misfit_square=square, lags=lags)
        fit = fit._replace(**{f"p{i}{j}": p[i, j] for i in range(3) for j in range(i, 3)})
        found = fitted(GAINS, WEIGHTS, fit, r, 1e-3, unit, others)
        assert found.lags == lagged(WEIGHTS, lags, unit)
        phi = np.array([1.0, r / GAINS.travel, found.lags.third])
        left = others - c - b * phi[1]
        k = p @ phi
        spread = GAINS.kept + phi @ k
        smoothed = misfit + GAINS.smooth * (left - misfit)
        after = p - np.outer(k, k) / spread
        # Nothing is forgotten where the trace would pass its bound.
        after /= GAINS.kept if np.trace(after) <= 30.0 * GAINS.kept else 1.0
        c, b, s = np.array([c, b, s]) + k * left / spread
        upper = after[np.triu_indices(3)]
        s = min(max(s, GAINS.smallest), GAINS.largest)
        expected = [c, b, s, *upper, smoothed, square + GAINS.mean * (smoothed**2 - square)]
        assert found[:11] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_while_the_reference_rests_the_fit_is_paused():
    fit = fit_after(500, 1.0)
    rested = fitted(GAINS, WEIGHTS, fit, 1e-5, 1e-7, 0.2, 5.0)
    assert rested[:11] == fit[:11] and rested.lags != fit.lags


def test_without_excitation_the_fit_neither_grows_beyond_bounds_nor_loses_the_size():
    fit = fit_after(2000, 1.0)
    for _ in range(30_000):
        fit = fitted(GAINS, WEIGHTS, fit, 0.0, 1e-3, 0.0, 0.0)
    assert fit.size == pytest.approx(1.0, rel=0.02)
    assert all(abs(number) < 20.0 for number in fit[:9])
    assert fit_after(2000, 2.0, fit=fit).size == pytest.approx(2.0, rel=0.05)
