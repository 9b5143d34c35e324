import math

import numpy as np
import pytest

from straightcomp_ros.analysis.metrics import evaluate
from straightcomp_ros.control.laws import ControlParameters, ObserverDesign, make_law
from straightcomp_ros.control.observer import observer_gains
from straightcomp_ros.control.smc_observer import _stiffness
from straightcomp_ros.model.lugre import bristle_after, friction_force
from straightcomp_ros.offline.starts import run_stroke
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
T = 5e-4
SETTLE = 0.5


def stroke(delay=0.5, friction=1.0, model="lugre", **design):
    """Record and metrics of a stroke whose plant has ``friction`` times the nominal friction."""
    values = shipped_parameters()
    values["controller"].update({f"control.smc_observer.{name}": value for name, value in design.items()})
    for name in ("friction.coulomb", "friction.static"):
        # The machine's alone: the law believes the description.
        values["driver"][f"stage.{name}"] = friction * values["stage"][name]
    values["driver"]["simulated.truth.contact.model"] = model
    values["stage"]["drive.delay"] = delay
    values["stage"].update({"motion.stroke": 0.6, "motion.settle": SETTLE, "motion.pause": SETTLE})
    record, straightness = run_stroke(values)
    return record, evaluate(record, straightness)


def law(**design):
    return make_law(ControlParameters(smc_observer=ObserverDesign(**design)), STAGE)


@pytest.mark.parametrize("third", [0.5, 1.0, 1.28])
def test_the_observers_gains_place_two_poles_at_its_bandwidth_and_the_third_beside(third):
    gains = np.array(observer_gains(150.0, third, T))
    step = np.array([[1, T, T**2 / 2], [0, 1, T], [0, 0, 1]])
    poles = np.sort(abs(np.linalg.eigvals(step @ (np.eye(3) - np.outer(gains, [1, 0, 0])))))
    pole = math.exp(-2 * math.pi * 150.0 * T)
    assert poles == pytest.approx(sorted([pole, pole, pole**third]), abs=1e-4)


@pytest.mark.no_cover  # whole strokes, which take three times as long under it
@pytest.mark.parametrize("friction", [0.33, 1.0, 2.0])
def test_a_stroke_with_unknown_friction_leaves_little_error_at_small_steps_of_the_current(friction):
    metrics = stroke(friction=friction)[1]
    assert metrics.true_pp < 0.2e-6 and metrics.true_rms < 0.026e-6
    assert metrics.control_rms_step < 5.5e-3


@pytest.mark.no_cover
def test_where_the_friction_model_explains_little_the_law_is_stiffer_and_leaves_less_error():
    def changed(stiffening):
        return stroke(model="maxwell_slip", stiffening=stiffening)[1]

    quiet, stiff = changed(1.0), changed(1.4)
    assert stiff.true_rms < 0.8 * quiet.true_rms
    assert stiff.control_rms_step > 2.0 * quiet.control_rms_step
    # With the model's friction the same stiffening is not used.
    assert stroke()[1].control_rms_step < 1.1 * stroke(stiffening=1.0)[1].control_rms_step


@pytest.mark.parametrize(("misfit", "share"), [(0.0, 0.0), (1.0, 0.0), (1.25, 0.25), (2.0, 1.0), (50.0, 1.0)])
def test_the_law_stiffens_between_one_and_two_tolerated_misfits(misfit, share):
    one = law()
    found = _stiffness(one.gains, (misfit * one.gains.misfit) ** 2)
    for name in ("surface", "reaching", "observer", "lags"):
        ends = [np.array(getattr(end, name)) for end in (one.gains.quiet, one.gains.stiff)]
        assert np.array(getattr(found, name)) == pytest.approx(ends[0] + share * (ends[1] - ends[0]))
    assert one.gains.stiff.surface == pytest.approx(1.4 * one.gains.quiet.surface)


def test_at_rest_the_command_is_held_and_leaving_rest_makes_no_step():
    record, _ = stroke()
    steps = np.abs(np.diff(record.current))
    start = round(SETTLE / T)
    turn = round(record.time.size / 2)  # in the middle of the pause; a half of it before
    assert not steps[start - 200 : start].any()
    assert not steps[turn + 100 : turn + 300].any()
    leaving = steps[start : start + 400]
    assert leaving[leaving > 0.0][0] < 1e-3
    assert leaving.max() <= 1.1 * steps[start + 400 : turn - 400].max()


def test_with_a_band_of_zero_the_command_is_never_held():
    steps = np.diff(stroke(rest_band=0.0)[0].current)
    assert steps[round(SETTLE / T) - 200 : round(SETTLE / T)].any()


def held(band=2.0):
    """The law after 0.2 s at rest, with an encoder that flickers by a count, and its commands."""
    servo = law(rest_band=band)
    servo.reset(0.0)
    commands = [servo.step(1e-7 * (k % 2), 0.0, 0.0, 0.0).current for k in range(400)]
    return servo, commands


def test_the_held_command_is_the_mean_of_the_last_ones():
    commands = held()[1]
    moving = held(band=0.0)[1]
    assert commands[-150:] == [commands[-1]] * 150
    assert commands[-1] == pytest.approx(np.mean(moving[100:200]), abs=0.5 * np.std(moving[100:200]))
    assert np.std(moving[100:200]) > 0.0


@pytest.mark.parametrize("reading", [0.3e-6, -0.3e-6])
def test_a_reading_outside_the_band_ends_the_hold(reading):
    servo, commands = held()
    answers = [servo.step(reading, 0.0, 0.0, 0.0).current for _ in range(3)]
    assert answers[-1] != commands[-1]
    # The law acts against the error.
    assert math.copysign(1.0, answers[0] - commands[-1]) == -math.copysign(1.0, reading)


def test_a_moving_reference_ends_the_hold():
    servo, commands = held()
    assert servo.step(0.0, 0.0, 2e-7, 0.0).current != commands[-1]


def test_the_friction_model_is_driven_by_the_reference_and_a_share_of_the_observed_velocity():
    design = ObserverDesign(first_size=1.0, velocity_share=0.25)
    one = make_law(ControlParameters(smc_observer=design), STAGE)
    state = one.start(0.0)
    state = state._replace(prior=state.prior._replace(velocity=4e-5))
    state, answer = one.function(one.gains, state, 0.0, 0.0, 1e-4, 0.0, math.nan)
    velocity = 0.75 * 1e-4 + 0.25 * answer.velocity_estimate
    lugre = one.gains.lugre
    assert state.bristle == pytest.approx(bristle_after(lugre, 0.0, velocity, T), rel=1e-12)
    friction = friction_force(lugre, state.bristle, velocity)
    others = state.prior.disturbance
    assert answer.disturbance_estimate == pytest.approx(others - friction * design.gain_allowance / 3.0, rel=1e-9)


def test_friction_starts_at_its_first_size_within_the_largest():
    assert law().start(0.0).fit.size == 0.15
    assert law(first_size=3.0, largest_size=2.0).start(0.0).fit.size == 2.0


def test_without_friction_the_law_has_none_of_its_own():
    one = law()
    state = one.start(1e-6)
    state = state._replace(fit=state.fit._replace(size=0.0), bristle=1e-7)
    after, answer = one.function(one.gains, state, 1e-6, 1e-6, 0.0, 0.0, math.nan)
    assert after.bristle == 1e-7 and answer.disturbance_estimate == 0.0


def test_what_friction_takes_over_the_disturbance_gives():
    """Two laws that differ only in the bound of the size: s F̄ and d have the same sum."""
    one = law(largest_size=0.2)
    free = law()
    state = free.start(0.0)
    for k in range(2000):
        sample = (1e-5 * math.sin(0.02 * k), 5e-6 * math.sin(0.02 * k), 2e-4 * math.cos(0.02 * k), 0.0, 0.0)
        before = state
        state, _ = free.function(free.gains, state, *sample)
        bound, _ = one.function(one.gains, before, *sample)
        totals = [each.prior.disturbance + each.fit.size * each.fit.lags.third for each in (state, bound)]
        assert totals[0] == pytest.approx(totals[1], abs=1e-9)
        if state.fit.size > 0.25:
            break
    assert state.fit.size > 0.2 == bound.fit.size
