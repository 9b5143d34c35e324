"""The excitation has the lines that it says, no more current than it may, and no steps."""

import numpy as np
import pytest

from straightcomp_ros.control.excitation import FrequencyResponseError, MultisineParameters, multisine
from straightcomp_ros.control.margins import LoopResponse

RATE = 2000.0


def flat(frequencies):
    """A loop that takes back nothing, on a plant that hardly moves."""
    ones = np.ones(len(frequencies), complex)
    return LoopResponse(1e-6 * ones, 0.0 * ones, ones)


def test_each_used_period_has_its_power_at_the_lines_alone_and_as_much_of_it_as_asked():
    excitation = multisine(MultisineParameters(current=0.2), RATE, flat)
    used = excitation.used(excitation.currents)
    assert used.shape == (40, 2000)
    spectrum = np.abs(np.fft.rfft(used, axis=1)) / 1000.0
    beside = np.delete(spectrum, excitation.bins, axis=1)
    assert beside.max() < 1e-12
    np.testing.assert_allclose(np.sqrt(np.mean(used**2, axis=1)), 0.2)
    assert excitation.frequencies[0] == 2.0 and excitation.frequencies[-1] == 500.0
    np.testing.assert_allclose(excitation.frequencies, excitation.bins * 1.0)


def test_draws_differ_in_their_phases_and_follow_each_other_without_a_step():
    excitation = multisine(MultisineParameters(lowest=2.0, highest=20.0, lines=8), RATE, flat)
    used = excitation.used(excitation.currents)
    assert np.abs(used[0] - used[1]).max() > 0.1
    steps = np.abs(np.diff(excitation.currents))
    assert steps.max() < 1.5 * np.abs(np.diff(used, axis=1)).max()
    assert excitation.currents[0] == 0.0


@pytest.mark.parametrize(("period", "lead"), [(0.2, 400), (0.8, 1000), (1.0, 1000), (4.0, 8000 // 2)])
def test_a_draw_begins_before_its_period_and_goes_over_into_it(period, lead):
    parameters = MultisineParameters(lowest=5.0, period=period, draws=3)
    excitation = multisine(parameters, RATE, flat)
    each = lead + excitation.samples
    assert excitation.currents.size == 3 * each == round(parameters.seconds * RATE)
    for draw, used in enumerate(excitation.used(excitation.currents)):
        settled = excitation.currents[draw * each + lead // 2 : draw * each + lead]
        np.testing.assert_allclose(settled, used[-settled.size :], atol=1e-12)


def test_where_the_loop_takes_the_signal_back_there_is_more_of_it_by_a_bounded_factor():
    def loop(frequencies):
        sensitivity = np.minimum(1.0, frequencies / 100.0).astype(complex)
        return LoopResponse(flat(frequencies).plant, 1.0 / sensitivity - 1.0, sensitivity)

    excitation = multisine(MultisineParameters(), RATE, loop)
    amplitudes = np.abs(np.fft.rfft(excitation.used(excitation.currents)[0]))[excitation.bins]
    high, low = amplitudes[-1], amplitudes[0]
    assert low / high == pytest.approx(3.0)
    middle = int(np.argmin(np.abs(excitation.frequencies - 60.0)))
    assert amplitudes[middle] / high == pytest.approx(100.0 / excitation.frequencies[middle])


def test_a_soft_plant_is_not_moved_beyond_the_travel():
    def soft(frequencies):
        return LoopResponse(1.0 / frequencies.astype(complex) ** 2, 0j * frequencies, 1.0 + 0j * frequencies)

    parameters = MultisineParameters(travel=6e-4)
    excitation = multisine(parameters, RATE, soft)
    amplitudes = np.abs(np.fft.rfft(excitation.used(excitation.currents)[0]))[excitation.bins] / 1000.0
    moved = amplitudes / excitation.frequencies**2
    assert np.sqrt(0.5 * np.sum(moved**2)) <= 1e-4 * (1.0 + 1e-9)


def test_a_lowest_frequency_of_less_than_one_period_is_refused():
    with pytest.raises(FrequencyResponseError, match=r"lowest frequency 0.5 Hz with a period of 1 s; allowed: >= 1 Hz"):
        multisine(MultisineParameters(lowest=0.5), RATE, flat)


def test_a_slow_rate_lowers_the_highest_frequency():
    assert multisine(MultisineParameters(), 1000.0, flat).frequencies[-1] == 400.0
