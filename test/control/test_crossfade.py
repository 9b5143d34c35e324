"""A change of law or gains leaves no bump in the command: bounds, held in closed loops without chance."""

import itertools
import math

import pytest

from straightcomp_ros.control.law import Command
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law
from straightcomp_ros.control.servo import FADE_TIME, Crossfade, Servo
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, load_map

STAGE = StageParameters()
RATE = 2000
T = 500_000
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


def run(old, change, steps=BEFORE + AFTER):
    """The simulated machine under ``old``; ``change(servo)`` is called at step BEFORE. Gives currents and errors."""
    machine = SimulatedHardware(
        SimulatedParameters(), STAGE, load_map(MapParameters(file="config/guide_synthetic.csv"))
    )
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
    return [abs(b - a) for a, b in itertools.pairwise(currents)]


@pytest.mark.parametrize(("before", "after"), list(itertools.permutations(LAWS, 2)))
def test_the_command_never_steps_by_more_than_the_laws_themselves_and_their_difference_over_n(before, after):
    old = Noted(make_law(ControlParameters(law=before), STAGE))
    new = Noted(make_law(ControlParameters(law=after), STAGE))
    currents, errors = run(old, lambda servo: servo.change(new, FADE))
    fading = range(BEFORE, BEFORE + FADE)
    olds, news = old.currents[BEFORE - 1 :], [new.currents[0], *new.currents]
    for place, step in enumerate(fading, 1):
        weight = place / FADE
        own = (1.0 - weight) * abs(olds[place] - olds[place - 1]) + weight * abs(news[place] - news[place - 1])
        bound = own + abs(news[place - 1] - olds[place - 1]) / FADE
        assert abs(currents[step] - currents[step - 1]) <= bound + 1e-12
        assert bound <= own + 2.0 * LIMIT / FADE
    assert currents[BEFORE + FADE :] == new.currents[FADE:]
    assert max(map(abs, errors[BEFORE - 100 :])) < 3e-6


class Constant:
    """A law that always asks for the same current."""

    def __init__(self, current):
        self._answer = Command(current, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def reset(self, y):
        """Nothing to forget."""

    def step(self, *_):
        return self._answer


@pytest.mark.parametrize(("samples", "largest"), [(FADE, 1.0 / FADE), (1, 1.0)])
def test_laws_that_differ_by_an_ampere_are_left_by_steps_of_an_nth(samples, largest):
    currents, _ = run(Constant(0.5), lambda servo: servo.change(Constant(-0.5), samples))
    assert max(steps_of(currents)) == pytest.approx(largest)
    assert (currents[0], currents[-1]) == (0.5, -0.5)


def test_a_change_within_a_change_ends_with_the_last_law():
    laws = [make_law(ControlParameters(law=law), STAGE) for law in ("linear", "smc", "smc_observer")]

    def change(servo):
        servo.change(laws[1], FADE)
        servo.change(laws[2], FADE)

    servos = []
    currents, errors = run(laws[0], lambda servo: (servos.append(servo), change(servo)))
    assert servos[0]._law is laws[2]
    assert max(steps_of(currents[BEFORE - 1 :])) < 0.05
    assert max(map(abs, errors[BEFORE:])) < 3e-6


def test_while_no_law_acts_the_new_one_is_there_at_once():
    old, new = (make_law(ControlParameters(law=law), STAGE) for law in ("linear", "smc"))
    servo = Servo(old)
    servo.change(new, FADE)
    fresh = Servo(make_law(ControlParameters(law="smc"), STAGE))
    assert repr(servo.step(0, 1e-7, 0.0, (0.0, 0.0, 0.0))) == repr(fresh.step(0, 1e-7, 0.0, (0.0, 0.0, 0.0)))  # NaN too


def test_a_reset_ends_a_fade():
    ended = []
    fade = Crossfade(*(make_law(ControlParameters(law=law), STAGE) for law in ("linear", "smc")), 10, ended.append)
    fade.reset(0.0)
    assert ended == [fade]


class Steady:
    """A law that always answers the same current."""

    def __init__(self, current):
        self._current = current

    def reset(self, y):
        """Nothing to forget."""

    def step(self, *_):
        return Command(self._current, *(math.nan,) * (len(Command._fields) - 1))


def test_a_change_during_a_fade_never_leaves_the_range_of_the_three_laws():
    # The first fade is the second one's old law, and is stepped beyond its own end.
    first = Crossfade(Steady(0.0), Steady(0.1), 10, lambda _: None)
    currents = [first.step(0.0).current for _ in range(5)]
    second = Crossfade(first, Steady(0.1), 10, lambda _: None)
    currents += [second.step(0.0).current for _ in range(10)]
    assert max(currents) == pytest.approx(0.1) and currents == sorted(currents)
    assert max(steps_of(currents)) <= 0.2 / 10 + 1e-12
