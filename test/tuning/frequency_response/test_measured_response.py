"""Responses: measured within circles as wide as they should be, in closed form, their margins; and the excitation."""

import dataclasses
import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from straightcomp_ros.control.excitation import (
    FrequencyResponseError,
    MultisineParameters,
    multisine,
)
from straightcomp_ros.control.laws import ControlParameters, make_law
from straightcomp_ros.control.margins import LoopResponse, loop_margins, loop_response
from straightcomp_ros.model.modes import ModeParameters
from straightcomp_ros.offline.starts import with_values
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.tuning.frequency_response.measured_response import (
    ComparedResponse,
    MeasuredResponse,
    ResponseMargins,
    compared_response,
    measured_response,
    response_margins,
)
from straightcomp_ros.tuning.frequency_response.response_plot import _phase
from straightcomp_ros.tuning.verbs import frequency_response

RATE = 1000.0


def flat(frequencies):
    ones = np.ones(len(frequencies), complex)
    return LoopResponse(1e-6 * ones, 0.0 * ones, ones)


EXCITATION = multisine(MultisineParameters(draws=12, lines=60, highest=400.0), RATE, flat)
D = EXCITATION.currents


def recorded(noise, seed=1):
    """y = 0.5 y₋₁ + u₋₁ under u = d − 0.3 y, both with white noise."""
    shaken = noise * np.random.default_rng(seed).standard_normal((2, D.size))
    u, y = np.empty(D.size), np.empty(D.size)
    state = 0.0
    for k in range(D.size):
        y[k] = state + shaken[0, k]
        u[k] = D[k] - 0.3 * y[k] + shaken[1, k]
        state = 0.5 * state + u[k]
    return measured_response(EXCITATION, D, u, y)


PLANT = 1.0 / (np.exp(2j * np.pi * EXCITATION.frequencies / RATE) - 0.5)
TRUTH = LoopResponse(PLANT, 0.3 * PLANT, 1.0 / (1.0 + 0.3 * PLANT))


def test_without_noise_the_response_is_exact_noise_lowers_the_coherence_and_a_dead_reading_has_none():
    found = recorded(0.0)
    for name in ("plant", "open_loop", "sensitivity"):
        np.testing.assert_allclose(getattr(found.response, name), getattr(TRUTH, name), rtol=1e-9)
    np.testing.assert_allclose(found.coherence, 1.0)
    assert found.plant_radius.max() < 1e-9 and found.coherent.all()
    assert recorded(0.5).coherence.mean() < recorded(0.1).coherence.mean() < 0.999
    dead = measured_response(EXCITATION, D, D, 0.0 * D)
    assert dead.coherence.max() == 0.0 and not dead.coherent.any()


def test_the_circles_hold_the_truth_in_95_of_100_cases_one_by_one_or_all_lines_at_once():
    inside, one_by_one, at_once = {"plant": [], "open_loop": [], "sensitivity": []}, [], []
    for seed in range(60):
        found = recorded(0.05, seed)
        assert found.coherent.all()
        misses = {
            name: np.abs(getattr(found.response, name) - getattr(TRUTH, name)) / getattr(found, f"{name}_radius")
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


def test_what_the_uncertainty_of_a_described_mode_leaves_open_does_not_contradict_the_description():
    mode = ModeParameters(180.0, 0.01, 0.5, -0.5, frequency_error=0.01, damping_factor=1.5, participation_error=0.1)
    excitation = multisine(MultisineParameters(lines=200, period=2.0), 2000.0, flat)

    def explained(frequency):
        """Whether the described mode explains one at ``frequency``, measured without noise."""
        plants = []
        for one in (mode, dataclasses.replace(mode, frequency=frequency)):
            stage = StageParameters().with_modes(one)
            law = make_law(ControlParameters(), stage)
            plants.append(loop_response(law, stage, excitation.frequencies, 10.0).plant)
        # Of a signal that is neither taken back nor added to, so that the reading is the plant's answer to it.
        spectrum = np.zeros((excitation.draws, excitation.samples // 2 + 1), complex)
        spectrum[:, excitation.bins] = np.fft.rfft(excitation.used(excitation.currents), axis=1)[:, excitation.bins]
        spectrum[:, excitation.bins] *= plants[1]
        reading = np.zeros_like(excitation.currents)
        excitation.used(reading)[:] = np.fft.irfft(spectrum, excitation.samples, axis=1)
        control, stage = ControlParameters(), StageParameters().with_modes(mode)
        asked = np.zeros_like(reading)
        found = compared_response(excitation, asked, excitation.currents, reading, control, stage, 0)
        return dataclasses.replace(found, model=dataclasses.replace(found.model, plant=plants[0])).explained

    assert explained(180.0) and explained(181.5) and not explained(186.0)


def test_a_response_that_is_not_a_number_is_not_explained():
    signal = D.copy()
    # The last draw is missing: all means over the draws are NaN, but the coherence is not.
    signal[-EXCITATION.samples :] = 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = measured_response(EXCITATION, signal, signal, 1e-6 * signal)
    assert measured.coherent.any() and np.isnan(measured.response.plant).all()
    assert not ComparedResponse("linear", measured, flat(EXCITATION.frequencies), 1.0, 0, 1.0).explained


def test_a_platform_that_no_count_shows_moving_has_no_coherent_line_and_explains_nothing():
    still = np.zeros_like(D)
    found = compared_response(EXCITATION, still, D, still, ControlParameters(), StageParameters(), 0)
    assert not found.measured.coherent.any() and not found.explained
    assert found.largest_deviations == (0.0, 0.0) and found.margins == 2 * (ResponseMargins(),)
    assert math.isfinite(found.damping) and np.isfinite(found.model.plant).all()


def test_a_swing_that_is_larger_than_what_any_line_moves_is_named_by_its_frequency():
    between, reading = int(EXCITATION.bins[20]) + 1, 1e-6 * D
    assert between not in EXCITATION.bins
    largest = np.abs(np.fft.rfft(EXCITATION.used(reading), axis=1)).max() / (0.5 * EXCITATION.samples)
    swing = np.sin(2.0 * np.pi * between * np.arange(D.size) / EXCITATION.samples)
    # Where the platform stands is no swing.
    reading += 1e-4
    assert measured_response(EXCITATION, D, D, reading + 1.5 * largest * swing).swing == pytest.approx(between)
    assert measured_response(EXCITATION, D, D, reading + 0.1 * largest * swing).swing == 0.0


def test_the_speed_is_that_of_the_motion_at_the_lines():
    spectrum = np.zeros(501, complex)
    line = int(EXCITATION.bins[10])
    spectrum[line] = 500.0 * 2e-6
    sine = np.tile(np.fft.irfft(spectrum, 1000), 24)
    assert measured_response(EXCITATION, D, D, sine).speed == pytest.approx(2.0 * np.pi * line * 2e-6 / np.sqrt(2.0))


F = np.geomspace(0.1, 100.0, 3000)
S = 2j * np.pi * F


def test_an_integrator_with_a_delay_has_the_textbooks_margins():
    delay, gain = 0.01, 50.0
    found = response_margins(F, gain * np.exp(-S * delay) / S)
    # ω_c = k, φ = 90° − k τ; ω_180 = π/(2τ), gain margin π/(2 k τ)
    assert found.crossover_Hz == pytest.approx(gain / (2.0 * np.pi), rel=1e-4)
    assert found.phase_deg == pytest.approx(90.0 - np.degrees(gain * delay), abs=0.01)
    assert found.gain_high == pytest.approx(np.pi / (2.0 * gain * delay), rel=1e-4)
    assert found.gain_low is None
    assert found.delay_us == pytest.approx((np.pi / (2.0 * gain) - delay) * 1e6, rel=1e-4)
    assert found.sensitivity_peak == pytest.approx(np.abs(1.0 / (1.0 + gain * np.exp(-S * delay) / S)).max())


def test_what_lies_beyond_the_lines_is_not_known():
    found = response_margins(F[F < 5.0], 50.0 / S[F < 5.0])
    assert found[:5] == (None,) * 5


def test_a_delay_turns_the_loop_only_one_way():
    # Phase of −L at the crossover is −30°: the critical point lies behind, so a delay has to turn L by 330°.
    loop = np.full(F.shape, -np.exp(-1j * np.radians(30.0))) * (10.0 / F)
    found = response_margins(F, loop)
    assert found.phase_deg == pytest.approx(30.0)
    assert found.delay_us == pytest.approx(330.0 / 360.0 / 10.0 * 1e6, rel=1e-4)


def test_lines_that_are_not_finite_are_left_out_and_no_line_has_no_margins():
    loop = 50.0 * np.exp(-S * 0.01) / S
    whole, holed = response_margins(F, loop), loop.copy()
    holed[[3, 40]] = np.nan
    assert response_margins(F, holed) == whole
    assert response_margins(F, np.full(F.shape, np.nan + 0j)) == (None,) * 7
    assert response_margins(F[:0], loop[:0]) == (None,) * 7


STAGE = StageParameters()
GRID = np.geomspace(0.5, 990.0, 4000)


@pytest.mark.parametrize("law", ["linear", "smc", "smc_observer"])
def test_in_the_picture_the_phase_margin_is_the_distance_of_the_open_loop_from_minus_180_degrees(law):
    loop = loop_response(make_law(ControlParameters(law=law), STAGE), STAGE, GRID)
    measured = SimpleNamespace(frequencies=GRID, response=loop)
    axes = Figure().add_subplot()
    _phase(axes, SimpleNamespace(measured=measured, model=loop), "open_loop")
    model, margins = np.asarray(axes.get_lines()[-2].get_ydata()), response_margins(GRID, loop.open_loop)
    assert np.interp(margins.crossover_Hz, GRID, model) + 180.0 == pytest.approx(margins.phase_deg, abs=0.5)


@pytest.mark.parametrize("law", ["linear", "smc"])
def test_margins_of_the_response_are_those_of_the_closed_loops_poles(law):
    made = make_law(ControlParameters(law=law), STAGE)
    found = response_margins(GRID, loop_response(made, STAGE, GRID).open_loop)
    poles = loop_margins(made, STAGE)
    assert found.gain_low == pytest.approx(poles.gain_low, rel=2e-3)
    assert found.gain_high == pytest.approx(poles.gain_high, rel=2e-3)
    assert found.phase_deg == pytest.approx(poles.phase, abs=0.2)
    assert found.delay_us == pytest.approx((poles.longest_delay - STAGE.drive.delay * STAGE.period) * 1e6, rel=5e-3)


def test_the_measured_current_is_part_of_the_loop_of_a_law_that_answers_to_it():
    law = make_law(ControlParameters(), STAGE)
    loop = loop_response(law, STAGE, GRID)
    np.testing.assert_allclose(loop.sensitivity * (1.0 + loop.open_loop), 1.0)
    seeing = response_margins(GRID, loop.open_loop).gain_high
    assert seeing is not None
    # The observer sees a current that is too large and takes back what it did: the margin is another than without.
    assert abs(seeing / loop_margins(law, STAGE).gain_high - 1.0) > 0.02


SMALL = {"platform.stop": 1.5e-4, "actuator.bias_current": 0.2, "actuator.current_limit": 0.18}


@pytest.mark.parametrize("running", [False, True])
@pytest.mark.parametrize(
    ("words", "current", "travel"), [("", 0.05, 5.25e-5), ("--current 0.02 --travel 4e-5", 0.02, 4e-5)]
)
def test_what_is_not_chosen_of_the_excitation_follows_from_the_stage_that_is_measured(
    monkeypatch, verb, running, words, current, travel
):
    seen, described = [], with_values(shipped_parameters(), "stage", SMALL)

    def measured(values, excitation, **_):
        seen.append(excitation)
        raise FrequencyResponseError("far enough")

    def access(*_):
        machine = SimpleNamespace(response=measured)
        return nullcontext(SimpleNamespace(machine=machine, values=described, report=lambda doing: None))

    monkeypatch.setattr(
        frequency_response, "chosen_parameters", lambda _: shipped_parameters() if running else described
    )
    monkeypatch.setattr(frequency_response, "measure_simulated", measured)
    monkeypatch.setattr(frequency_response, "graph_access", access)
    assert verb("frequency-response", *words.split(), *(["--graph", "running"] if running else [])).code != 0
    (excitation,) = seen
    assert (excitation.current, excitation.travel) == pytest.approx((current, travel))
