"""The detector finds what oscillates by itself, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from nominal import EXACT, within

from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.offline.sweep.limit_cycle import LEAST_AMPLITUDE, sustained_oscillation
from straightcomp_ros.offline.sweep.many_trials import run_trials
from straightcomp_ros.offline.sweep.scenario import make_scenario

T = 5e-4
TIME = np.arange(8000) * T
NOISE = 0.1e-6 * np.random.default_rng(1).standard_normal(TIME.size)


def sine(frequency: float) -> np.ndarray:
    return 0.3e-6 * np.sin(2.0 * np.pi * frequency * TIME)


@pytest.mark.parametrize("frequency", [45.0, 142.0, 190.7, 900.0])
def test_a_held_line_is_found_in_noise_with_its_amplitude_and_frequency(frequency):
    found = sustained_oscillation(sine(frequency) + NOISE, T)
    assert found.amplitude == pytest.approx(0.3e-6, rel=0.15)
    assert found.frequency == pytest.approx(frequency, abs=4.0)


@pytest.mark.parametrize(
    "error",
    [
        pytest.param(NOISE, id="white noise"),
        pytest.param(30.0 * sine(15.0), id="what the guide asks for"),
        pytest.param(np.where(TIME % 1.0 < 0.5, 2e-6, -2e-6), id="slips"),
        pytest.param(20.0 * sine(150.0) * np.exp(-TIME / 0.05), id="an answer that dies away"),
        pytest.param(np.where(TIME < 0.4, sine(150.0), 0.0), id="a burst"),
        pytest.param(np.zeros_like(TIME), id="nothing"),
        pytest.param(sine(150.0)[:400], id="less than a piece"),
    ],
)
def test_what_is_no_held_line_is_no_oscillation(error):
    assert sustained_oscillation(error, T).amplitude < LEAST_AMPLITUDE


def test_a_law_that_switches_with_sgn_limit_cycles(values):
    values["stage"]["motion.stroke"] = 0.1
    values["controller"] = {"control.smc.boundary_layer": 0.0}
    (result,) = run_trials(make_scenario(within(EXACT, values), ["smc"]), 1, [0])
    assert result.limit_cycle and result.frequency > 100.0


def test_a_gain_too_high_for_the_delay_limit_cycles_where_half_the_delay_does_not(values):
    values["stage"]["motion.stroke"] = 0.1
    values["controller"] = {"control.smc.phi": 300.0, "control.smc.rho": 3.0}
    late, early = (
        run_trials(
            make_scenario(within(replace(EXACT, shortest_delay=delay, longest_delay=delay), values), ["smc"]), 1, [0]
        )[0]
        for delay in (1.5, 0.2)
    )
    assert late.limit_cycle and not early.limit_cycle


@pytest.mark.parametrize("law", LAWS)
def test_no_law_limit_cycles_on_the_machine_that_it_was_designed_for(values, law):
    values["stage"]["motion.stroke"] = 0.1
    (result,) = run_trials(make_scenario(within(EXACT, values), [law]), 1, [0])
    assert not result.limit_cycle
