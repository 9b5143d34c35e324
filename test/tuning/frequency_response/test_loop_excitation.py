"""Excitations of each kind: the same table from the same parameters, within its limits."""

import numpy as np
import pytest

from straightcomp_ros.control.excitation import ExcitationParameters, made_injection, simple_currents
from straightcomp_ros.control.laws import OPEN_LOOP, ControlParameters, make_law
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()


def answered(parameters, law=OPEN_LOOP):
    injection = made_injection(parameters, make_law(ControlParameters(law=law), STAGE), STAGE)
    answers = []
    while not injection.finished:
        answers.append(injection.step(0.0, 0.0))
    return np.array(answers)


def test_a_shake_takes_each_step_back_and_repeats_with_its_seed():
    shake = ExcitationParameters(signal="shake", current=0.01, duration=0.25)
    currents = simple_currents(shake, STAGE)
    assert currents.size == 500 and np.abs(currents).max() <= 0.01 and (currents[::2] == -currents[1::2]).all()
    assert (simple_currents(shake, STAGE) == currents).all()
    assert np.abs(np.cumsum(currents)).max() <= 0.01


@pytest.mark.parametrize(("signal", "sign"), [("ramp_up", 1.0), ("ramp_down", -1.0)])
def test_a_ramp_goes_evenly_to_its_current_and_drops_to_zero(signal, sign):
    currents = answered(ExcitationParameters(signal=signal, current=0.5, duration=2.0))
    assert currents.size == 4000 and currents[0] == 0.0 and currents[-1] == 0.0
    assert sign * currents[-2] == pytest.approx(0.5, rel=1e-3)
    assert np.allclose(np.diff(sign * currents[:-1]), 0.5 / 3999)


def test_a_multisine_is_injected_under_a_law_with_a_slow_rise():
    parameters = ExcitationParameters(draws=3)
    currents = answered(parameters, "smc_observer")
    assert currents.size == parameters.seconds * STAGE.rate
    assert np.abs(currents[:10]).max() < 0.05 * np.abs(currents).max()


def test_nothing_exceeds_the_limit_of_the_current():
    assert np.abs(answered(ExcitationParameters(signal="ramp_up", current=10.0))).max() == STAGE.highest_current
