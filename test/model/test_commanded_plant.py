"""The plant under the commands of its board: when they take effect, and what the board does without one."""

import numpy as np
import pytest

from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.model.plant import (
    BIAS,
    COMMAND,
    READING,
    Hold,
    PlantParameters,
    PlantState,
    advance,
    advance_to_sample,
    as_array,
    commanded_plant,
)

PERIOD = 500_000
HOLD = Hold(after_ns=625_000, weight=0.1, kept=0.6, braking=0.5, stiffness=7000.0)
PLANT = PlantParameters(encoder=EncoderParameters(x_resolution=1e-6))
STEP = PLANT.drive.current_step


def machine(hold=HOLD, bias=PLANT.actuator.bias_current, y=2e-6):
    plant = commanded_plant(PLANT, hold, PlantState(y=y))
    plant.state[BIAS] = bias
    return plant


def sample(plant, until, commands=(), noise=0.0):
    effective, asked = (np.array(column) for column in zip(*commands, strict=True)) if commands else (
        np.empty(0, np.int64), np.empty(0))  # fmt: skip
    return advance_to_sample(*plant, effective, asked, len(commands), until, noise)


def test_a_sample_with_a_command_in_between_is_the_plant_advanced_twice():
    plant, state = machine(), np.array(PlantState(y=2e-6))
    bias = PLANT.actuator.bias_current
    assert sample(plant, PERIOD, [(200_000, 0.1), (600_000, 0.2)]) == 1
    current = round(0.1 / STEP) * STEP
    advance(as_array(PLANT.constants()), state, bias, 0.0, 200_000, current, 300_000)
    np.testing.assert_array_equal(plant.state[: state.size], state)
    assert plant.state[COMMAND] == current
    assert plant.state[READING] == PLANT.encoder.y_reading(float(state[0]))


def test_noise_moves_the_reading_and_not_the_platform():
    quiet, noisy = machine(), machine()
    sample(quiet, PERIOD)
    sample(noisy, PERIOD, noise=3e-6)
    np.testing.assert_array_equal(quiet.state[:READING], noisy.state[:READING])
    assert noisy.state[READING] - quiet.state[READING] == pytest.approx(3e-6, abs=1e-7)


def test_without_a_command_the_board_holds_from_its_time_on_and_a_command_ends_that():
    plant = machine()
    sample(plant, PERIOD, [(0, 0.1)])
    current = plant.state[COMMAND]
    held_from = HOLD.after_ns
    assert held_from < 2 * PERIOD and plant.times[1] == held_from and not plant.times[2]
    anchor = plant.state[READING]
    sample(plant, 2 * PERIOD)
    assert plant.times[2]
    # Mean 0.01 A; impulses of 0.6 · 0.09 A at the first sample, and as the hold begins; then at the second sample.
    mean = HOLD.weight * current
    impulse = HOLD.kept * (current - mean)
    impulse = HOLD.kept * (impulse + current - mean)
    first = round((mean - HOLD.braking * impulse) / STEP) * STEP
    impulse = HOLD.kept * (impulse + first - mean)
    displacement = plant.state[READING] - anchor
    expected = mean - HOLD.braking * impulse - HOLD.stiffness * displacement
    assert plant.state[COMMAND] == pytest.approx(expected, abs=0.51 * STEP)
    sample(plant, 3 * PERIOD, [(2 * PERIOD, -0.1)])
    assert plant.state[COMMAND] == pytest.approx(-0.1, abs=STEP) and not plant.times[2]


def test_while_the_amplifier_is_off_commands_are_taken_and_have_no_effect():
    plant = machine(bias=0.0)
    assert sample(plant, PERIOD, [(0, 0.5), (100_000, -0.5)]) == 2
    assert plant.state[COMMAND] == 0.0 and plant.times[1] > 2**60
    sample(plant, 10 * PERIOD)
    assert not plant.times[2] and plant.state[COMMAND] == 0.0


def test_after_the_currents_went_off_nothing_is_held_and_no_impulse_is_left():
    plant = machine()
    sample(plant, PERIOD, [(0, 0.1)])
    plant.currents_off()
    assert not plant.state[BIAS : COMMAND + 3].any()
    sample(plant, 5 * PERIOD)
    assert plant.state[COMMAND] == 0.0 and not plant.times[2]
