"""The compiled step of each law is the step function itself, to the last bit."""

import math
import random

import pytest

from straightcomp_ros.control.law import flat
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()


def samples(count):
    """A platform that wanders, jumps now and then, and has no measured current at times."""
    source, y = random.Random(1), 0.0
    for _ in range(count):
        y = source.uniform(-1e-3, 1e-3) if source.random() < 0.01 else y + source.uniform(-2e-7, 2e-7)
        r, r_dot, r_ddot = (source.uniform(-most, most) for most in (1e-5, 1e-4, 1e-3))
        yield round(y / 1e-7) * 1e-7, r, r_dot, r_ddot, source.choice((math.nan, source.uniform(-1.0, 1.0)))


@pytest.mark.parametrize("name", LAWS)
def test_the_compiled_step_equals_the_function_to_the_last_bit(name):
    law = make_law(ControlParameters(law=name), STAGE)
    law.reset(2e-6)
    state = law.start(2e-6)
    for sample in samples(2000):
        state, expected = law.function(law.gains, state, *sample)
        # repr tells every bit, and NaN equals NaN.
        assert repr(law.step(*sample)) == repr(expected)


@pytest.mark.parametrize("name", LAWS)
def test_whole_numbers_are_taken_for_what_they_are_and_compile_nothing_anew(name):
    law = make_law(ControlParameters(law=name), STAGE)
    before = len(law._run.signatures)
    answer = law.step(0, 0, 0, 0, 0)
    law.reset(0)
    assert repr(answer) == repr(law.step(0.0, 0.0, 0.0, 0.0, 0.0))
    assert len(law._run.signatures) == before == 1


def test_two_laws_of_a_kind_have_each_a_state_of_its_own():
    one, other = (make_law(ControlParameters(), STAGE) for _ in range(2))
    for sample in samples(50):
        one.step(*sample)
    fresh = make_law(ControlParameters(), STAGE)
    for sample in samples(50):
        assert repr(other.step(*sample)) == repr(fresh.step(*sample))


def test_flat_numbers_are_in_the_order_of_the_tuples():
    assert flat((1.0, (2.0, (3.0, 4.0)), 5.0)) == [1.0, 2.0, 3.0, 4.0, 5.0]
