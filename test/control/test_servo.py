"""One control cycle: which reference a sample gets, and when; repeated, old and wrong samples; changes of law without
a bump; a test signal within limits."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from surveys import GUIDE

from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.law import Command, Law, _rebuilt
from straightcomp_ros.control.laws import LAWS, OPEN_LOOP, ControlParameters, make_law
from straightcomp_ros.control.pairing import Pairing, extrapolated
from straightcomp_ros.control.servo import AMPLIFIER_OFF, FADE_TIME, Servo
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.feedforward import FADE_TIME as MAP_FADE_TIME
from straightcomp_ros.straightness.feedforward import Feedforward
from straightcomp_ros.straightness.guide_map import load_map

T = 500_000
HELD, REST = (1e-6, 0.0, 0.0), (0.0, 0.0, 0.0)


def servo():
    return Servo(make_law(ControlParameters(law="linear"), StageParameters()))


def same(one, other):
    """To the last bit, and NaN equals NaN."""
    return repr(one) == repr(other)


def test_a_repeated_sample_gets_the_same_answer_and_an_older_or_a_wrong_one_none_and_nothing_changes():
    loop, other = servo(), servo()
    wrong = ((math.nan, HELD), (math.inf, HELD), (0.0, (math.nan, 0.0, 0.0)), (0.0, (0.0, math.inf, 0.0)))
    for step in range(1, 5):
        first = loop.step(step * T, 1e-7 * step, 0.0, HELD)
        assert same(loop.step(step * T, 1e-7 * step, 0.0, HELD), first)
        assert loop.step((step - 1) * T, 0.0, 0.0, HELD) is None
        assert [loop.step((step + 1) * T, y, 0.0, reference) for y, reference in wrong] == [None] * 4
        assert same(other.step(step * T, 1e-7 * step, 0.0, HELD), first)


def test_while_the_amplifier_is_off_nothing_is_integrated():
    waiting, fresh = servo(), servo()
    for step in range(1000):
        answer = waiting.step(step * T, 0.0, math.nan, HELD)
        assert answer is not None and answer.current == AMPLIFIER_OFF.current == 0.0
    assert same(waiting.step(1000 * T, 0.0, 0.0, HELD), fresh.step(0, 0.0, 0.0, HELD))


@pytest.mark.parametrize("next_ns", [10**12 + 100 * T + 10**9, 10**6], ids=["long gap", "clock set back"])
def test_after_a_long_gap_or_a_clock_step_backward_the_law_starts_anew(next_ns):
    loop, fresh = servo(), servo()
    for step in range(100):
        loop.step(10**12 + step * T, 0.0, 0.0, HELD)
    assert same(loop.step(next_ns, 0.0, 0.0, HELD), fresh.step(0, 0.0, 0.0, HELD))


def test_at_the_lowest_rate_a_sample_that_is_as_late_as_any_jitter_makes_it_does_not_start_the_law_anew():
    (lowest, latest) = (
        next(one for one in declarations(StageParameters) if one.name == name)
        for name in ("rate", "uncertainty.jitter")
    )
    late = round((1.0 + 2.0 * latest.maximum) * 1e9 / lowest.minimum)
    loop = servo()
    answers = [loop.step(step * late, 0.0, 0.0, HELD) for step in range(3)]
    # The integral goes on.
    assert answers[0].current < answers[1].current < answers[2].current


def test_in_open_loop_the_command_is_zero_and_the_error_is_reported():
    loop = Servo(make_law(ControlParameters(law=OPEN_LOOP), StageParameters()))
    assert not loop.running
    answer = loop.step(T, 3e-6, 0.1, HELD)
    assert answer is not None and answer.current == 0.0 and answer.error == 1e-6 - 3e-6
    assert loop.running


STAGE = StageParameters()
RATE = 2000
FADE = round(FADE_TIME * RATE)
BEFORE, AFTER = 600, 600
LIMIT = STAGE.actuator.current_limit


def reference(step):
    """Half a hertz, ± 5 µm: the platform never stands still for long."""
    w, t = math.pi, step / RATE
    return 5e-6 * math.sin(w * t), 5e-6 * w * math.cos(w * t), -5e-6 * w * w * math.sin(w * t)


class Noted:
    """A law whose answers are kept."""

    def __init__(self, law):
        self._law, self.currents = law, []

    def reset(self, y):
        self._law.reset(y)

    def step(self, *arguments):
        answer = self._law.step(*arguments)
        self.currents.append(answer.current)
        return answer


def run(old, change, steps=BEFORE + AFTER, reference=reference):
    """The simulated machine under ``old``; ``change(servo)`` is called at step BEFORE. Gives currents and errors."""
    machine = SimulatedHardware(SimulatedParameters(), STAGE, GUIDE)
    servo, currents, errors = Servo(old), [], []
    machine.start(0)
    machine.enable()
    for step in range(steps):
        if step == BEFORE:
            change(servo)
        [(sample, _)] = machine.read(step * T)
        answer = servo.step(sample.stamp_ns, sample.y, sample.current, reference(step))
        machine.write(answer.current, sample.stamp_ns + T // 2)
        currents.append(answer.current)
        errors.append(answer.error)
    return currents, errors


def steps_of(currents):
    return np.abs(np.diff(currents))


@pytest.mark.parametrize("names", list(itertools.permutations(LAWS, 2)))
def test_the_command_never_steps_by_more_than_the_laws_themselves_and_their_difference_over_n(names):
    old, new = (Noted(make_law(ControlParameters(law=name), STAGE)) for name in names)
    currents, errors = run(old, lambda servo: servo.change(new, FADE))
    olds, news = np.array(old.currents[BEFORE - 1 :]), np.array([new.currents[0], *new.currents[:FADE]])
    weight = np.arange(1, FADE + 1) / FADE
    own = (1.0 - weight) * abs(np.diff(olds)) + weight * abs(np.diff(news))
    bound = own + abs(news[:-1] - olds[:-1]) / FADE
    assert (steps_of(currents[BEFORE - 1 : BEFORE + FADE]) <= bound + 1e-12).all()
    assert (bound <= own + 2.0 * LIMIT / FADE).all()
    assert currents[BEFORE + FADE :] == new.currents[FADE:]
    assert max(map(abs, errors[BEFORE - 100 :])) < 3e-6


def test_the_command_does_not_step_further_during_a_change_of_map_than_without_one():
    straightness, difference = load_map(), 20e-6

    def other(x):
        r, slope, curvature = straightness.reference(x)
        return r + difference, slope, curvature

    def largest(changed):
        feedforward = Feedforward(straightness)
        currents, errors = run(
            make_law(ControlParameters(), STAGE),
            lambda servo: feedforward.change(other) if changed else None,
            BEFORE + 1400,
            lambda step: feedforward.step(step * T, 0.2 + 0.1 * step / RATE),
        )
        return steps_of(currents)[BEFORE - 200 :].max(), np.abs(errors[BEFORE - 200 :]).max()

    (plain, plain_error), (changed, changed_error) = largest(False), largest(True)
    # K_y D / K_i is the current that the other place takes; it comes over the whole fade.
    assert changed <= 1.5 * plain + 1.875 * (29.8e3 * difference / 44.7) / RATE / MAP_FADE_TIME
    assert changed_error < plain_error + 0.3e-6


def test_while_no_law_acts_the_new_one_is_there_at_once():
    changed = servo()
    changed.change(make_law(ControlParameters(law="smc"), STAGE), FADE)
    fresh = Servo(make_law(ControlParameters(law="smc"), STAGE))
    assert same(changed.step(0, 1e-7, 0.0, HELD), fresh.step(0, 1e-7, 0.0, HELD))


def answering(gains, state, y, r, *_):
    return state, Command(*gains, r - y, 0.0, *gains, 0.0, 0.0, math.nan)


def steady(current):
    """A law that always answers the same current; it has nothing to forget."""
    return Law((current,), lambda y: (0.0,), answering)


def test_a_change_during_a_fade_never_leaves_the_range_of_the_three_laws_and_ends_with_the_last():
    loop, laws = Servo(steady(0.0)), [steady(0.1), steady(0.1)]
    numbers = itertools.count()

    def steps(count):
        return [loop.step(next(numbers) * T, 0.0, 0.0, REST).current for _ in range(count)]

    currents = steps(1)
    loop.change(laws[0], 10)
    currents += steps(5)
    # The first fade is the second one's old law until it is over.
    loop.change(laws[1], 20)
    currents += steps(19)
    assert loop._law is not laws[1]
    currents += steps(1)
    assert loop._law is laws[1] and currents[-1] == pytest.approx(0.1)
    assert currents == sorted(currents) and max(steps_of(currents)) <= 0.2 / 10 + 1e-12


def test_laws_that_change_faster_than_they_fade_cost_no_more_time_the_more_there_were():
    class Counted:
        steps = 0

        def reset(self, y):
            pass

        def step(self, *_):
            Counted.steps += 1
            return AMPLIFIER_OFF

    loop, most = Servo(Counted()), 0
    for k in range(100 * FADE // 2):
        if k % (FADE // 2) == 1:
            loop.change(Counted(), FADE)
        Counted.steps = 0
        loop.step(k * T, 0.0, 0.0, REST)
        most = max(most, Counted.steps)
    # Of two fades, and of one that ends at this sample.
    assert most <= 4


def test_a_fade_ends_where_the_law_starts_anew():
    loop, new = Servo(steady(0.0)), steady(0.1)
    loop.step(0, 0.0, 0.0, REST)
    loop.change(new, 10)
    assert loop.step(T, 0.0, 0.0, REST).current == pytest.approx(0.01)
    assert loop.step(T + 10**9, 0.0, 0.0, REST).current == 0.1


FLAT = np.full(1000, 0.2)


def made(currents=FLAT, **changed):
    return Injection(currents, **{"fade": 100, "limit": 0.9, "travel": 1e-4, **changed})


def answers(injection, count, command=0.0):
    return np.array([injection.step(command, 0.0) for _ in range(count)])


def test_the_signal_rises_from_zero_and_ends_at_zero():
    injection = made()
    added = answers(injection, 1200)
    assert added[0] == pytest.approx(0.002) and added[998] == pytest.approx(0.002) and added[999] == 0.0
    assert np.abs(np.diff(added)).max() <= 0.002 + 1e-12
    assert (added[100:900] == 0.2).all() and (added[1000:] == 0.0).all()
    assert injection.finished and injection.stopped == ""


@pytest.mark.parametrize("beyond", [5e-3 - 1.1e-4, math.nan])
def test_beyond_the_travel_from_where_it_began_the_signal_fades_out_at_once_and_says_why(beyond):
    injection = made()
    for _ in range(500):
        injection.step(0.0, 5e-3)
    assert not injection.stopped
    injection.step(0.0, beyond)
    fading = answers(injection, 200)
    assert f"y − r changed by {abs(beyond - 5e-3) * 1e6:.3g} µm; allowed: 100 µm" in injection.stopped
    assert np.abs(np.diff(fading)).max() <= 0.002 + 1e-12 and (fading[99:] == 0.0).all()
    assert injection.finished


def test_command_and_signal_together_stay_within_the_limit():
    injection = made(limit=0.5)
    total = answers(injection, 1000, command=0.4)
    assert total.max() == 0.5 and injection.clipped == np.count_nonzero(0.4 + answers(made(), 1000) > 0.5) > 800
    assert answers(made(-FLAT, limit=0.5), 1000, command=-0.4).min() == -0.5


def test_the_servo_adds_the_signal_once_a_sample_and_leaves_what_the_law_asked_for():
    servo = Servo(steady(0.1))
    servo.inject(made(0.2 + np.arange(1000.0) / 1e4, fade=1))
    command = servo.step(0, 0.0, 0.0, REST)
    assert command.current == pytest.approx(0.3)
    assert command.equivalent_current + command.switching_current == pytest.approx(0.1)
    assert servo.step(0, 0.0, 0.0, REST) == command
    assert servo.step(500_000, 0.0, 0.0, REST).current == pytest.approx(0.3 + 1e-4)


UNREST = np.random.default_rng(1).normal(0.0, 3e-6, 2000)
STANDS = np.where(UNREST > 0.0, 3e-7, 4e-7)


@pytest.mark.parametrize(
    ("path", "excited", "rest_band", "doubted"),
    [(UNREST, False, 2.0, True), (UNREST, True, 2.0, False), (UNREST, False, 0.0, False), (STANDS, False, 2.0, False)],
)
def test_unrest_before_the_first_motion_says_that_friction_is_less_than_described(path, excited, rest_band, doubted):
    """Not where a test signal moves the platform, not for a law that never lets it rest, and not of one that stands."""
    control = replace(ControlParameters().smc_observer, rest_band=rest_band)
    law = make_law(ControlParameters(smc_observer=control), StageParameters())
    servo = Servo(law)
    if excited:
        servo.inject(made(np.zeros(2000), fade=1))
    for k, y in enumerate(path):
        servo.step(k * T, float(y), 0.0, REST)
    left = _rebuilt(law.start(0.0), iter(law._state)).fit.size / law.start(0.0).fit.size
    assert left < 0.1 if doubted else left == 1.0


def test_with_the_amplifier_off_the_signal_is_forgotten_and_says_so():
    servo, injection = Servo(steady(0.1)), made(fade=1)
    servo.inject(injection)
    commands = [servo.step(k * T, 0.0, current, REST).current for k, current in enumerate((0.0, math.nan, 0.0))]
    assert commands == pytest.approx([0.3, 0.0, 0.1])
    assert injection.stopped == "the amplifier was off, or samples were missing"


START = 1_700_000_000_000_000_000


def at(index):
    return START + index * T


def quadratic(stamp_ns):
    """r, ṙ, r̈ of a parabola: its extrapolation is exact."""
    t = (stamp_ns - START) * 1e-9
    return 1e-6 + 2e-3 * t + 0.5 * 0.3 * t * t, 2e-3 + 0.3 * t, 0.3


@given(st.integers(0, 8), st.lists(st.tuples(st.booleans(), st.booleans()), max_size=60))
def test_in_whatever_order_messages_arrive_a_sample_gets_the_reference_of_an_earlier_one_at_its_own_time(lead, turns):
    """In lockstep it waits for it. Sent again, a sample is answered again, and a reference changes nothing."""
    pairing, samples, references, answered = Pairing(lead * T, wait=True), [], [], []
    for of_sample, again in turns:
        sent = samples if of_sample else references
        repeats = again and bool(sent)
        k = len(set(sent)) - repeats
        sent.append(k)
        if of_sample:
            pairing.add_sample(at(k), (k,))
        else:
            pairing.add_reference(at(k), REST if repeats else quadratic(at(k)))
        answered += pairing.take()
    expected = []
    for k in samples:
        age = min(k, lead)
        if k - age in references:
            reference = extrapolated(*quadratic(at(k - age)), age * T * 1e-9)
            expected.append((at(k), (k,), reference, age * T))
    assert answered == expected and pairing.waits is (len(answered) < len(samples))


def test_in_real_time_the_newest_reference_is_used_until_it_is_too_old():
    pairing = Pairing(2 * T, wait=False)
    pairing.add_reference(at(0), quadratic(at(0)))
    answered = []
    for k in range(200):
        pairing.add_sample(at(k), (k,))
        answered += pairing.take()
    assert [stamp for stamp, *_ in answered] == [at(k) for k in range(101)]  # 50 ms
    assert answered[-1][2] == pytest.approx(quadratic(at(100)), rel=1e-12)
    pairing.add_reference(at(199), quadratic(at(199)))
    assert [stamp for stamp, *_ in pairing.take()][-1] == at(199)


@pytest.mark.parametrize("starts", [(10_000, 0), (0, 1000)], ids=["clock set back", "gap"])
def test_after_a_gap_or_a_clock_that_was_set_back_old_references_are_used_no_more(starts):
    pairing = Pairing(2 * T, wait=False)
    for first in starts:
        for k in range(first, first + 5):
            pairing.add_sample(at(k), (k,))
            if k == 1000:
                assert not list(pairing.take())
            pairing.add_reference(at(k), (float(first), 0.0, 0.0))
            ((stamp_ns, _, reference, _),) = pairing.take()
            assert (stamp_ns, reference[0]) == (at(k), first)


def test_samples_without_a_reference_are_forgotten_in_time_and_counted():
    pairing = Pairing(2 * T, wait=False)
    for k in range(1500):
        pairing.add_sample(at(k), (k,))
    assert not list(pairing.take()) and pairing.unmatched == 500


def test_references_run_short_when_a_sample_to_come_has_none_of_its_own():
    pairing = Pairing(8 * T, wait=False)
    assert pairing.short(0)
    for k in range(20):
        pairing.add_sample(at(k), (k,))
    pairing.add_reference(at(12), quadratic(at(12)))
    assert not pairing.short(T)
    assert pairing.short(2 * T)
