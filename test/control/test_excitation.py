"""Test signals: what they hold, within which limits, and how they begin and end."""

import math

import numpy as np
import pytest

from straightcomp_ros.control.excitation import (
    ExcitationParameters,
    FrequencyResponseError,
    MultisineParameters,
    bearable_travel,
    made_injection,
    multisine,
    multisine_injection,
    simple_currents,
    suited_multisine,
)
from straightcomp_ros.control.laws import OPEN_LOOP, ControlParameters, make_law
from straightcomp_ros.control.margins import LoopResponse
from straightcomp_ros.parameters.declaration import from_mapping
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()


def flat(frequencies):
    ones = np.ones(len(frequencies), complex)
    return LoopResponse(1e-6 * ones, 0.0 * ones, ones)


HZ = 2000.0


def test_each_used_period_has_its_power_at_the_lines_alone_and_as_much_of_it_as_asked():
    excitation = multisine(MultisineParameters(current=0.2), HZ, flat)
    used = excitation.used(excitation.currents)
    assert used.shape == (40, 2000)
    spectrum = np.abs(np.fft.rfft(used, axis=1)) / 1000.0
    others = np.delete(spectrum, excitation.bins, axis=1)
    assert others.max() < 1e-12
    np.testing.assert_allclose(np.sqrt(np.mean(used**2, axis=1)), 0.2)
    assert excitation.frequencies[0] == 2.0 and excitation.frequencies[-1] == 500.0
    np.testing.assert_allclose(excitation.frequencies, excitation.bins * 1.0)


@pytest.mark.parametrize(("period", "lead"), [(0.2, 400), (0.8, 1000), (1.0, 1000), (4.0, 4000)])
def test_a_draw_of_other_phases_begins_before_its_period_and_goes_over_into_it_without_a_step(period, lead):
    parameters = MultisineParameters(lowest=5.0, highest=20.0, lines=8, period=period, draws=3)
    excitation = multisine(parameters, HZ, flat)
    currents, used, each = excitation.currents, excitation.used(excitation.currents), lead + excitation.samples
    assert currents.size == 3 * each == round(parameters.seconds * HZ) and currents[0] == 0.0
    for draw, one in enumerate(used):
        settled = currents[draw * each + lead // 2 : draw * each + lead]
        np.testing.assert_allclose(settled, one[-settled.size :], atol=1e-12)
    # Halfway between nothing and the first draw.
    assert currents[lead // 4] == pytest.approx(0.5 * used[0][lead // 4 - lead], abs=1e-12)
    assert np.abs(used[0] - used[1]).max() > 0.1
    assert np.abs(np.diff(currents)).max() < 1.5 * np.abs(np.diff(used, axis=1)).max()


def amplitudes_under(parameters, loop):
    """The lines of a multisine, and the sizes (n,) in A of their currents."""
    excitation = multisine(parameters, HZ, loop)
    spectrum = np.fft.rfft(excitation.used(excitation.currents)[0])
    return excitation.frequencies, np.abs(spectrum)[excitation.bins] / 1000.0


def test_where_the_loop_takes_the_signal_back_there_is_more_of_it_by_a_bounded_factor_and_within_the_travel():
    def loop(frequencies):
        sensitivity = np.minimum(1.0, frequencies / 100.0).astype(complex)
        return LoopResponse(flat(frequencies).plant, 1.0 / sensitivity - 1.0, sensitivity)

    def soft(frequencies):
        return LoopResponse(1.0 / frequencies.astype(complex) ** 2, 0j * frequencies, 1.0 + 0j * frequencies)

    frequencies, amplitudes = amplitudes_under(MultisineParameters(), loop)
    assert amplitudes[0] / amplitudes[-1] == pytest.approx(3.0)
    middle = int(np.argmin(np.abs(frequencies - 60.0)))
    assert amplitudes[middle] / amplitudes[-1] == pytest.approx(100.0 / frequencies[middle])
    frequencies, amplitudes = amplitudes_under(MultisineParameters(travel=6e-4), soft)
    # Each line moves the platform alike, to a sixth of the travel RMS, unless that takes more than its share of 0.25 A.
    each = np.minimum(0.25, 1e-4 * frequencies**2) * math.sqrt(2.0 / frequencies.size)
    np.testing.assert_allclose(amplitudes, each, rtol=1e-9)


def test_the_highest_frequency_follows_the_rate_and_a_lowest_one_of_less_than_one_period_is_refused():
    for rate, highest in ((1000.0, 400.0), (2000.0, 500.0), (8000.0, 2000.0)):
        assert multisine(MultisineParameters(), rate, flat).frequencies[-1] == highest
    assert multisine(MultisineParameters(highest=700.0), 8000.0, flat).frequencies[-1] == 700.0


@pytest.mark.parametrize(
    ("wrong", "allowed"),
    [
        ({"lowest": 0.5}, r"lowest frequency 0\.5 Hz .*>= 1 Hz and below the highest of 500 Hz"),
        ({"lowest": 500.0}, r"lowest frequency 500 Hz .*below the highest of 500 Hz"),
        ({"period": 0.002, "lowest": 500.0}, r"period of 0\.002 s; allowed: > 0\.002 s"),
        ({"period": 0.05, "lowest": 20.0, "draws": 4}, r"last 0\.4 s; allowed: >= 0\.5 s"),
    ],
)
def test_an_excitation_whose_lines_period_or_rise_do_not_fit_is_refused(wrong, allowed):
    law = make_law(ControlParameters(law="linear"), STAGE)
    with pytest.raises(FrequencyResponseError, match=allowed):
        multisine_injection(MultisineParameters(**wrong), law, STAGE)


def test_of_draws_that_just_hold_rise_and_fall_an_excitation_is_made_which_the_travel_of_its_parameters_ends():
    parameters = MultisineParameters(period=0.05, lowest=20.0, draws=5, travel=1e-4)
    _, injection = multisine_injection(parameters, make_law(ControlParameters(law="linear"), STAGE), STAGE)
    assert len([injection.step(0.0, 0.0) for _ in range(1000)]) == 1000 and injection.finished
    for error, stopped in ((0.9e-4, False), (1.1e-4, True)):
        _, injection = multisine_injection(parameters, make_law(ControlParameters(law="linear"), STAGE), STAGE)
        for one in (0.0, error):
            injection.step(0.0, one)
        assert bool(injection.stopped) is stopped


def test_without_a_choice_the_excitation_is_a_share_of_the_bias_current_of_the_limit_and_of_the_way_to_the_stop():
    weak = from_mapping(StageParameters, {"actuator.bias_current": 0.2, "platform.stop": 4e-4})
    limited = from_mapping(StageParameters, {"actuator.current_limit": 0.36})
    chosen = [suited_multisine(stage, lines=7) for stage in (STAGE, weak, limited)]
    assert [(one.current, one.travel) for one in chosen] == [
        pytest.approx(expected) for expected in ((0.25, 3e-4), (0.05, 1.4e-4), (0.1, 3e-4))
    ]
    assert {one.lines for one in chosen} == {7} and bearable_travel(weak) == pytest.approx(1.4e-4)


def injected(parameters, law=OPEN_LOOP):
    """All currents (n,) in A of an injection."""
    injection = made_injection(parameters, make_law(ControlParameters(law=law), STAGE), STAGE)
    currents = []
    while not injection.finished:
        currents.append(injection.step(0.0, 0.0))
    return np.array(currents)


def test_a_shake_takes_each_step_back_and_repeats_with_its_seed():
    shake = ExcitationParameters(signal="shake", current=0.01, duration=0.25)
    currents = simple_currents(shake, STAGE)
    assert currents.size == 500 and np.abs(currents).max() <= 0.01 and (currents[::2] == -currents[1::2]).all()
    assert (simple_currents(shake, STAGE) == currents).all()
    assert np.abs(np.cumsum(currents)).max() <= 0.01


@pytest.mark.parametrize(("signal", "sign"), [("ramp_up", 1.0), ("ramp_down", -1.0)])
def test_a_ramp_goes_evenly_to_its_current_but_to_the_limit_at_most_and_drops_to_zero(signal, sign):
    currents = sign * injected(ExcitationParameters(signal=signal, current=0.5, duration=2.0))
    assert currents.size == 4000 and currents[0] == 0.0 and currents[-1] == 0.0
    assert currents[-2] == pytest.approx(0.5, rel=1e-3)
    assert np.allclose(np.diff(currents[:-1]), 0.5 / 3999)
    assert np.abs(injected(ExcitationParameters(signal=signal, current=10.0))).max() == STAGE.highest_current


def test_a_multisine_is_injected_under_a_law_with_a_slow_rise():
    parameters = ExcitationParameters(draws=3)
    currents = injected(parameters, "linear")
    assert currents.size == parameters.seconds * STAGE.rate
    assert np.abs(currents[:10]).max() < 0.05 * np.abs(currents).max()
