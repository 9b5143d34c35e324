"""What is measured on a linear loop is its response, within circles that are as wide as they should be."""

import dataclasses

import numpy as np
import pytest

from straightcomp_ros.control.excitation import MultisineParameters, multisine
from straightcomp_ros.control.margins import LoopResponse
from straightcomp_ros.tuning.frequency_response.measured_response import (
    ComparedResponse,
    MeasuredResponse,
    measured_response,
)

RATE = 1000.0


def flat(frequencies):
    ones = np.ones(len(frequencies), complex)
    return LoopResponse(1e-6 * ones, 0.0 * ones, ones)


def recorded(noise, seed=1):
    """y = 0.5 y₋₁ + u₋₁ under u = d − 0.3 y, both with white noise."""
    excitation = multisine(MultisineParameters(draws=12, lines=60, highest=400.0), RATE, flat)
    random = np.random.default_rng(seed)
    d, shaken = excitation.currents, noise * random.standard_normal((2, excitation.currents.size))
    u, y = np.empty(d.size), np.empty(d.size)
    state = 0.0
    for k in range(d.size):
        y[k] = state + shaken[0, k]
        u[k] = d[k] - 0.3 * y[k] + shaken[1, k]
        state = 0.5 * state + u[k]
    return excitation, measured_response(excitation, d, u, y)


def truth(frequencies):
    z = np.exp(2j * np.pi * frequencies / RATE)
    plant = 1.0 / (z - 0.5)
    return LoopResponse(plant, 0.3 * plant, 1.0 / (1.0 + 0.3 * plant))


def test_without_noise_the_response_is_exact_noise_lowers_the_coherence_and_a_dead_reading_has_none():
    excitation, found = recorded(0.0)
    true = truth(excitation.frequencies)
    for name in ("plant", "open_loop", "sensitivity"):
        np.testing.assert_allclose(getattr(found.response, name), getattr(true, name), rtol=1e-9)
    np.testing.assert_allclose(found.coherence, 1.0)
    assert found.plant_radius.max() < 1e-9 and found.coherent.all()
    assert recorded(0.5)[1].coherence.mean() < recorded(0.1)[1].coherence.mean() < 0.999
    dead = measured_response(excitation, excitation.currents, excitation.currents, 0.0 * excitation.currents)
    assert dead.coherence.max() == 0.0 and not dead.coherent.any()


def test_the_circles_hold_the_truth_in_95_of_100_cases_one_by_one_or_all_lines_at_once():
    inside, one_by_one, at_once = {"plant": [], "open_loop": [], "sensitivity": []}, [], []
    for seed in range(60):
        excitation, found = recorded(0.05, seed)
        assert found.coherent.all()
        true = truth(excitation.frequencies)
        misses = {
            name: np.abs(getattr(found.response, name) - getattr(true, name)) / getattr(found, f"{name}_radius")
            for name in inside
        }
        for name, miss in misses.items():
            inside[name].append(miss <= 1.0)
        one_by_one.append(misses["plant"].max() <= 1.0)
        at_once.append(misses["plant"].max() <= found.jointly)
    assert all(0.92 < np.mean(one) < 0.98 for one in inside.values())
    assert np.mean(at_once) >= 0.88
    # With 95 % for each of 59 lines, hardly any measurement has all of them inside.
    assert np.mean(one_by_one) < 0.3


@pytest.mark.parametrize(
    ("factor", "radius", "coherence", "explained"),
    [
        pytest.param(1.1, 0.01, 0.99, True, id="within 1 dB"),
        pytest.param(1.15, 0.01, 0.99, False, id="beyond 1 dB"),
        pytest.param(0.87, 0.01, 0.99, False, id="below 1 dB"),
        pytest.param(1.2, 0.07, 0.99, True, id="its circle reaches within 1 dB"),
        pytest.param(np.exp(0.1j), 0.01, 0.99, False, id="beyond 5°"),
        pytest.param(1.15, 0.2, 0.99, True, id="within its circle"),
        pytest.param(1.15, 0.01, 0.8, True, id="not coherent"),
    ],
)
def test_a_model_is_rejected_by_a_line_that_is_coherent_and_certainly_off_or_by_no_line(
    factor, radius, coherence, explained
):
    model, ones = flat(np.arange(3.0)), np.ones(3)
    plant = model.plant * np.array([1.0, factor, 1.0])
    coherent, circles = np.array([0.99, coherence, 0.99]), radius * 1e-6 * ones
    measured = MeasuredResponse(
        ones, LoopResponse(plant, model.open_loop, model.sensitivity), coherent, circles, ones, ones, 1e-3, 40
    )
    assert ComparedResponse("linear", measured, model, 1.0, 0, 1.0).explained is explained
    silent = dataclasses.replace(measured, coherence=0.5 * ones)
    assert not ComparedResponse("linear", silent, model, 1.0, 0, 1.0).explained


def test_a_response_that_is_not_a_number_is_not_explained():
    excitation, _ = recorded(0.0)
    signal = excitation.currents.copy()
    # The last draw is missing: all means over the draws are NaN, but the coherence is not.
    signal[-excitation.samples :] = 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = measured_response(excitation, signal, signal, 1e-6 * signal)
    assert measured.coherent.any() and np.isnan(measured.response.plant).all()
    assert not ComparedResponse("linear", measured, flat(excitation.frequencies), 1.0, 0, 1.0).explained


def test_the_speed_is_that_of_the_motion_at_the_lines():
    excitation, _ = recorded(0.0)
    spectrum = np.zeros(501, complex)
    line = int(excitation.bins[10])
    spectrum[line] = 500.0 * 2e-6
    sine = np.tile(np.fft.irfft(spectrum, 1000), 24)
    found = measured_response(excitation, excitation.currents, excitation.currents, sine)
    assert found.speed == pytest.approx(2.0 * np.pi * line * 2e-6 / np.sqrt(2.0))
