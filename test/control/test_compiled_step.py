"""The compiled step of each law is the step function to the last bit."""

import inspect
import math
import pickle
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest

from straightcomp_ros.control.excitation import Injection
from straightcomp_ros.control.law import Command, Law, flat
from straightcomp_ros.control.laws import LAWS, ControlParameters, make_law, prepare_all
from straightcomp_ros.model.compiled import compilable
from straightcomp_ros.model.plant import advance
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
        # repr shows every bit, and NaN equals NaN.
        assert repr(law.step(*sample)) == repr(expected)


def test_the_steps_of_all_laws_are_prepared_together(monkeypatch):
    prepared = []
    monkeypatch.setattr(Law, "prepare", lambda law: prepared.append(law.function))
    prepare_all()
    assert prepared == [make_law(ControlParameters(law=name), STAGE).function for name in LAWS]


@pytest.mark.parametrize("name", LAWS)
def test_a_law_answers_from_any_state_with_the_reference_at_rest_at_zero_and_keeps_its_own(name):
    law = make_law(ControlParameters(law=name), STAGE)
    plain = Law(law.gains, law.start, law.function)
    before = flat(law.start(2e-6))
    for y, current in ((1e-6, 0.1), (-3e-7, math.nan)):
        state, expected = law.function(law.gains, law.start(2e-6), y, 0.0, 0.0, 0.0, current)
        for one in (law.prepare(), plain):
            one.reset(0.0)
            assert repr(one.answer_from(before, y, current)) == repr((flat(state), expected))
            assert flat(one._state) == flat(law.start(0.0))


@pytest.mark.parametrize("name", LAWS)
def test_whole_numbers_are_taken_for_what_they_are_and_compile_nothing_anew(name):
    law = make_law(ControlParameters(law=name), STAGE).prepare()
    before = len(law._run.signatures)
    answer = law.step(0, 0, 0, 0, 0)
    law.reset(0)
    assert repr(answer) == repr(law.step(0.0, 0.0, 0.0, 0.0, 0.0))
    assert len(law._run.signatures) == before == 1


class Total(NamedTuple):
    """A user's own gain, and state."""

    value: float


def own_law(factor, gain):
    """A law of a user that adds up its readings; it begins with a whole number."""

    @compilable
    def step(gains, state, y, r, r_dot, r_ddot, current):
        total = state.value + gains.value * factor * y
        return Total(total), Command(total, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    return [Law(Total(kind(gain)), lambda y: Total(0), step, compiled=True) for kind in (int, float)]


@pytest.mark.parametrize("factor", [1.0, 5.0])
def test_each_of_a_users_own_laws_computes_what_its_step_says_with_whole_numbers_too(factor):
    for law in own_law(factor, 2):
        assert [law.step(0.25, 0.0, 0.0, 0.0).current for _ in range(2)] == [0.5 * factor, 1.0 * factor]
        assert law.answer_from([1], 0.25)[1].current == 1.0 + 0.5 * factor


def test_several_threads_may_begin_with_a_law_at_a_time():
    with ThreadPoolExecutor(2) as threads:
        assert [*threads.map(lambda law: law.step(0.25, 0.0, 0.0, 0.0).current, own_law(3.0, 2))] == [1.5, 1.5]


def test_a_thread_that_prepares_a_law_and_one_that_has_begun_with_the_plant_do_not_wait_for_each_other():
    # In a process of its own: once numba is there, the first is done before the second begins.
    program = """import sys, threading, time
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.model.plant import advance_to_sample
from straightcomp_ros.stage.description import StageParameters
first = threading.Thread(target=lambda: advance_to_sample.dispatcher)
first.start()
while "numba" not in sys.modules: time.sleep(1e-3)
make_law(ControlParameters(), StageParameters()).prepare()
first.join()"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.parametrize("name", LAWS)
def test_the_source_of_a_compiled_step_is_that_of_the_function(name):
    law = make_law(ControlParameters(law=name), STAGE).prepare()
    assert inspect.getsource(law._run.py_func) == inspect.getsource(law.function)


@pytest.mark.parametrize("name", LAWS)
def test_an_infinite_current_is_none_measured_and_a_state_that_is_no_number_is_not_answered_by_the_limit(name):
    law, other = (make_law(ControlParameters(law=name), STAGE) for _ in range(2))
    for sample in samples(20):
        for current in (math.inf, -math.inf):
            assert repr(law.step(*sample[:4], current)) == repr(other.step(*sample[:4], math.nan))
    state, broken = law.function(law.gains, law.start(0.0), math.nan, 0.0, 1e-5, 0.0, 0.0)
    law.step(math.nan, 0.0, 1e-5, 0.0, 0.0)
    injection = Injection(np.ones(4), fade=1, limit=STAGE.actuator.current_limit, travel=1.0)
    answers = broken, law.function(law.gains, state, 0.0, 0.0, 1e-5, 0.0, 0.0)[1], law.step(0.0, 0.0, 1e-5, 0.0, 0.0)
    assert all(math.isnan(injection.step(answer.current, 0.0)) for answer in answers)


def test_a_compiled_function_goes_to_another_process_by_its_name():
    assert pickle.loads(pickle.dumps(advance)) is advance
    assert advance.__name__ == "advance" and "constants" in advance.__doc__
