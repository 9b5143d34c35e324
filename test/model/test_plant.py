"""The magnets; the plant by itself, and under the commands of its board; its converters."""

import math
from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.actuator import (
    UNIT_GAIN_ERROR_LIMIT,
    ActuatorParameters,
    control_current,
    magnetic_force,
    stiffness_errors,
)
from straightcomp_ros.model.converters import DriveParameters, EncoderParameters
from straightcomp_ros.model.disturbances import OFFSET, DisturbanceParameters, DriftParameters
from straightcomp_ros.model.friction import LuGreParameters
from straightcomp_ros.model.modes import MODE_STATE, ModeParameters, ModesParameters, at_coil
from straightcomp_ros.model.plant import (
    BIAS,
    COMMAND,
    PLACE,
    READING,
    SPEED,
    SUBSTEP_NS,
    Hold,
    PlantParameters,
    PlatformParameters,
    advance,
    advance_to_sample,
    commanded_plant,
    plant_state,
    substep_for,
)

NO_FRICTION = LuGreParameters(
    coulomb=1e-12, static=1e-12, bristle_stiffness=1e-3, bristle_damping=0.0, viscous=0.0, stribeck_velocity=1.0
)
State = namedtuple("State", "y velocity bristle control bias friction_force magnetic_force", defaults=(0.0,) * 7)
FREE = PlantParameters(friction=NO_FRICTION)
STICKY = PlantParameters()


def run(parameters, state, command, seconds, bias=1.0):
    array = np.array(state)
    advance(parameters.constants(), array, bias, command, round(seconds * 1e9))
    return State(*array)


def energy(state):
    """Kinetic energy plus the magnets' potential at the present currents, in J.

    The potential of (2) at constant currents is −(μ0N²A/4) [i₁²/(y0−y) + i₂²/(y0+y)].
    """
    magnets = FREE.actuator.constants()
    near = (state.bias + state.control) ** 2 / (magnets.air_gap - state.y)
    far = (state.bias - state.control) ** 2 / (magnets.air_gap + state.y)
    return 0.5 * FREE.platform.mass * state.velocity**2 - magnets.force_coefficient * (near + far)


def test_energy_is_conserved_where_there_is_no_friction():
    # A wide swing toward the centre, against the negative stiffness. Currents other than one ampere, its own square.
    state = start = State(y=2e-4, velocity=-0.022, control=0.005, bias=1.1)
    kinetic = 0.5 * FREE.platform.mass * start.velocity**2
    for _ in range(40):
        state = run(FREE, state, 0.005, 1e-3, bias=1.1)
        assert abs(energy(state) - energy(start)) < 1e-5 * kinetic
    assert abs(state.y - start.y) > 1e-4  # it did move


def test_the_integration_is_of_second_order():
    def position(step_ns):
        state = plant_state(y=3e-4, velocity=-0.02, bias=1.0)
        for _ in range(20_000_000 // step_ns):
            advance(FREE.constants(), state, 1.0, 0.05, step_ns)
        return state[0]

    # One call of a duration below SUBSTEP_NS is one substep.
    exact, coarse, fine = (position(SUBSTEP_NS // parts) for parts in (100, 1, 2))
    assert (coarse - exact) / (fine - exact) == pytest.approx(4.0, rel=0.1)


def test_the_amplifier_is_of_first_order_and_the_forces_are_those_of_the_state():
    tau = 1.0 / (2 * math.pi * STICKY.drive.bandwidth)
    state = run(STICKY, State(y=1e-5, bias=1.0), 0.1, tau)
    assert state.control == pytest.approx(0.1 * (1 - math.exp(-1)), rel=1e-6)
    acceleration = (state.magnetic_force - state.friction_force) / STICKY.platform.mass
    later = run(STICKY, state, 0.1, 1e-6)
    assert (later.velocity - state.velocity) / 1e-6 == pytest.approx(acceleration, rel=0.02)
    # With the amplifier off the magnets pull to no side.
    off = run(FREE, State(y=1e-4, bias=1.0, control=0.3), 0.0, 0.05, bias=0.0)
    assert off.magnetic_force == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_platform_stays_between_its_stops(side):
    after = run(FREE, State(y=side * 1e-3, bias=1.0), 0.0, 1.0)
    assert after.y == pytest.approx(side * FREE.platform.stop)
    # With the bias off and a little push it comes back from there.
    pushed = run(FREE, after._replace(bias=0.0, velocity=-side * 0.01), 0.0, 0.02, bias=0.0)
    assert abs(pushed.y) < FREE.platform.stop - 1e-4


def test_the_coils_stay_between_the_stops_where_a_mode_would_carry_them_beyond():
    modes = ModesParameters(ModeParameters(72.0, 0.008, 0.5, -0.5))
    plant = PlantParameters(PlatformParameters(modes=modes), friction=NO_FRICTION)
    constants, state, farthest = plant.constants(), plant_state(bias=1.0), 0.0
    for sample in range(4000):
        # In step with the mode: what a loop does that it makes unstable.
        command = math.copysign(1.0, math.sin(2.0 * math.pi * 72.0 * sample * 5e-4))
        advance(constants, state, 1.0, command, 500_000)
        farthest = max(farthest, abs(at_coil(constants, state, 0)))
    assert farthest == pytest.approx(plant.platform.stop, rel=1e-6)
    assert np.abs(state[MODE_STATE : MODE_STATE + 4]).max() < 10.0


PERIOD = 500_000
HOLD = Hold(after_ns=625_000, weight=0.1, kept=0.6, braking=0.5, stiffness=7000.0)
COUNTED = PlantParameters(encoder=EncoderParameters(x_resolution=1e-6))
STEP = COUNTED.drive.current_step


def machine(hold=HOLD, bias=COUNTED.actuator.bias_current):
    plant = commanded_plant(COUNTED, hold, plant_state(y=2e-6))
    plant.state[BIAS] = bias
    return plant


def sample(plant, until, commands=(), noise=0.0):
    effective = np.array([at for at, _ in commands], np.int64)
    asked = np.array([current for _, current in commands], np.float64)
    return advance_to_sample(*plant, effective, asked, len(commands), until, noise, 0.0)


def test_a_sample_with_a_command_in_between_is_the_plant_advanced_twice_and_noise_moves_the_reading_alone():
    plant, state = machine(), plant_state(y=2e-6)
    bias = COUNTED.actuator.bias_current
    assert sample(plant, PERIOD, [(200_000, 0.1), (600_000, 0.2)]) == 1
    current = round(0.1 / STEP) * STEP
    advance(COUNTED.constants(), state, bias, 0.0, 200_000, current, 300_000)
    np.testing.assert_array_equal(plant.state[: state.size], state)
    assert plant.state[COMMAND] == current
    noisy = machine()
    sample(noisy, PERIOD, [(200_000, 0.1), (600_000, 0.2)], noise=3e-6)
    np.testing.assert_array_equal(noisy.state[:READING], plant.state[:READING])
    for found, noise in ((plant, 0.0), (noisy, 3e-6)):
        assert found.state[READING] == COUNTED.encoder.y_reading(float(state[0]) + noise)


def test_without_a_command_the_board_holds_from_its_time_on_and_a_command_ends_that():
    plant = machine()
    sample(plant, PERIOD, [(0, 0.1)])
    current, anchor = plant.state[[COMMAND, READING]]
    assert PERIOD < HOLD.after_ns < 2 * PERIOD and plant.times[1] == HOLD.after_ns and not plant.times[2]
    sample(plant, 2 * PERIOD)
    assert plant.times[2]
    # Mean 0.01 A; impulses of 0.6 · 0.09 A at the first sample, and as the hold begins; then at the second sample.
    mean = HOLD.weight * current
    impulse = HOLD.kept * (HOLD.kept * (current - mean) + current - mean)
    first = round((mean - HOLD.braking * impulse) / STEP) * STEP
    impulse = HOLD.kept * (impulse + first - mean)
    expected = mean - HOLD.braking * impulse - HOLD.stiffness * (plant.state[READING] - anchor)
    assert plant.state[COMMAND] == pytest.approx(expected, abs=0.51 * STEP)
    sample(plant, 3 * PERIOD, [(2 * PERIOD, -0.1)])
    assert plant.state[COMMAND] == pytest.approx(-0.1, abs=STEP) and not plant.times[2]


def test_while_the_amplifier_is_off_commands_have_no_effect_and_nothing_is_held():
    plant = machine(bias=0.0)
    assert sample(plant, PERIOD, [(0, 0.5), (100_000, -0.5)]) == 2 and plant.times[1] > 2**60
    switched_off = machine()
    sample(switched_off, PERIOD, [(0, 0.1)])
    switched_off.currents_off()
    assert not switched_off.state[BIAS : COMMAND + 3].any()
    for one in (plant, switched_off):
        sample(one, 10 * PERIOD)
        assert one.state[COMMAND] == 0.0 and not one.times[2]


ENCODER = EncoderParameters(x_resolution=1e-6, y_resolution=1e-7)
DRIVE = DriveParameters()


@given(st.floats(-5.0, 5.0))
def test_a_reading_is_the_nearest_count_and_a_current_the_nearest_step_within_the_range(value):
    for reading, count in ((ENCODER.x_reading(value), 1e-6), (ENCODER.y_reading(value), 1e-7)):
        assert abs(reading - value) <= 0.5000001 * count
        assert reading / count == pytest.approx(round(reading / count), abs=1e-6)
    converted, highest = DRIVE.converted(value), DRIVE.current_range - DRIVE.current_step
    assert abs(converted - min(max(value, -DRIVE.current_range), highest)) <= 0.5000001 * DRIVE.current_step
    assert -DRIVE.current_range <= converted <= highest


def test_rounding_to_counts_errs_by_what_is_said_and_the_highest_code_gives_the_largest_current():
    values = np.linspace(0.0, 1e-5, 10_001)
    errors = np.array([ENCODER.y_reading(value) for value in values.tolist()]) - values
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(ENCODER.y_rounding, rel=1e-2)
    assert DRIVE.converted(5.0) == DRIVE.largest_current < DRIVE.current_range == -DRIVE.converted(-5.0)


def test_a_flexure_pulls_the_platform_back_against_the_magnets_and_damps_it():
    platform = PlatformParameters(stiffness=8e4, damping=60.0)
    flexed = PlantParameters(platform=platform, friction=LuGreParameters(coulomb=0.0, static=0.0, viscous=0.0))
    rate = math.sqrt((8e4 - flexed.actuator.position_stiffness) / 3.0)
    decay = 60.0 / (2.0 * 3.0)
    turning = math.sqrt(rate * rate - decay * decay)
    t, state = 0.02, run(flexed, State(y=1e-6, bias=1.0), 0.0, 0.02)
    swing = math.cos(turning * t) + decay / turning * math.sin(turning * t)
    assert state.y == pytest.approx(1e-6 * math.exp(-decay * t) * swing, rel=1e-3)


def test_a_platform_stuck_on_very_stiff_bristles_swings_at_its_own_rate():
    """1e10 N/m under 0.3 kg: 29 kHz, which substeps of 25 µs would not resolve."""
    stiff = LuGreParameters(coulomb=1e3, static=1e3, bristle_stiffness=1e10, bristle_damping=0.0, viscous=0.0)
    stuck = PlantParameters(platform=PlatformParameters(mass=0.3), friction=stiff)
    rate = math.sqrt((1e10 - stuck.actuator.position_stiffness) / 0.3)
    speeds = [run(stuck, State(velocity=1e-6, bias=1.0), 0.0, n * 1e-6).velocity for n in range(1, 40)]
    expected = [1e-6 * math.cos(rate * n * 1e-6) for n in range(1, 40)]
    assert speeds == pytest.approx(expected, abs=0.1e-6)


@pytest.mark.parametrize(
    ("mass", "stiffness", "damping", "static", "substep"),
    [
        # Half over the rate of 1e6 N/m of bristles and 3e6 N/m of a flexure, over that of all dampers; the bounds.
        (1e-3, 3e6, 0.0, 0.5, 0.5 / math.sqrt(4e6 / 1e-3) * 1e9),
        (1e-3, 3e6, 0.0, 0.0, 0.5 / math.sqrt(3e6 / 1e-3) * 1e9),
        (1e-3, 0.0, 80.0, 0.5, 0.5 / ((15.0 + 5.0 + 80.0) / 1e-3) * 1e9),
        (3.0, 0.0, 0.0, 0.5, SUBSTEP_NS),
        (1e-9, 0.0, 0.0, 0.5, 100),
    ],
)
def test_a_substep_resolves_the_fastest_motion_of_the_platform(mass, stiffness, damping, static, substep):
    lugre = LuGreParameters(static, static, bristle_damping=15.0, viscous=5.0).constants()
    assert substep_for(mass, lugre, stiffness, damping) == pytest.approx(substep, rel=1e-3)


def test_modes_make_the_platform_lighter_to_its_bristles():
    modes = ModesParameters(*(ModeParameters(300.0, 0.01, coil, 1.0) for coil in (5.0, 3.0)))
    flexible, rigid = PlatformParameters(mass=0.1, modes=modes), PlatformParameters(mass=0.1 / (1.0 + 25.0 + 9.0))
    substeps = [PlantParameters(platform).constants()[14] for platform in (flexible, rigid)]
    assert substeps[0] == substeps[1] < SUBSTEP_NS


def test_the_truth_has_the_rate_where_the_encoder_looks_and_all_that_the_coils_pull_with():
    modes, drift = ModesParameters(ModeParameters(180.0, 0.01, 0.5, -2.0)), DriftParameters(current=0.05, time=1e6)
    off = replace(DisturbanceParameters(), drift=drift).machine()
    plant = PlantParameters(PlatformParameters(modes=modes), disturbances=off)
    shaken = commanded_plant(plant, HOLD, plant_state(y=2e-6))
    shaken.state[BIAS] = plant.actuator.bias_current
    sample(shaken, 0)
    for n in range(10):
        sample(shaken, (n + 1) * PERIOD, [(n * PERIOD, 0.3 * (-1) ** n)])
    now, later = shaken.state.copy(), shaken.state
    sample(shaken, 10 * PERIOD + 1000)
    assert abs(now[OFFSET]) > 0.01 and abs(now[SPEED] - now[1]) > 1e-5
    assert (later[PLACE] - now[PLACE]) / 1e-6 == pytest.approx(now[SPEED], rel=1e-2)
    accelerated = (now[6] - now[5]) / plant.platform.mass
    assert (later[1] - now[1]) / 1e-6 == pytest.approx(accelerated, rel=1e-2)


DESCRIBED = ActuatorParameters()
MAGNETS = DESCRIBED.constants()
GAP, I_0 = DESCRIBED.air_gap, DESCRIBED.bias_current
K_I, K_Y = DESCRIBED.current_stiffness, DESCRIBED.position_stiffness


def force(y, i):
    return magnetic_force(MAGNETS, y, I_0, i)


def test_the_consistent_plant_has_the_stiffnesses_of_the_design_document():
    assert pytest.approx(44.7, abs=0.05) == K_I
    assert pytest.approx(29.8e3, abs=50) == K_Y
    assert math.sqrt(K_Y / 3.0) == pytest.approx(100, abs=1)


@given(st.floats(-0.95, 0.95), st.floats(-1.0, 1.0))
def test_the_force_is_its_closed_form_in_a_and_b_and_that_of_equation_3_with_its_stiffness_errors(a, b):
    m_y, m_i = stiffness_errors(a, b)
    closed = K_I * I_0 * (a + b) * (1 + a * b) / (1 - a * a) ** 2
    # (4) splits the cross terms so that K_y y + K_i i_c is (2) again.
    by_3 = (1 + m_y) * K_Y * a * GAP + (1 + m_i) * K_I * b * I_0
    for expected in (closed, by_3):
        assert force(a * GAP, b * I_0) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert 1 + m_i >= 0.0


def test_gain_error_reaches_one_exactly_at_the_limit_of_the_position():
    b = np.linspace(-1, 1, 401)
    worst = lambda a: max(abs(stiffness_errors(a, i)[1]) for i in b)  # noqa: E731
    assert pytest.approx(0.3660, abs=5e-5) == UNIT_GAIN_ERROR_LIMIT
    assert worst(UNIT_GAIN_ERROR_LIMIT) == pytest.approx(1.0, abs=1e-12)
    assert worst(UNIT_GAIN_ERROR_LIMIT - 1e-3) < 1.0 < worst(UNIT_GAIN_ERROR_LIMIT + 1e-3)


@given(st.floats(-0.95, 0.95) | st.sampled_from([0.0, 1e-9, -1e-9, 1e-6]), st.floats(-1.0, 1.0))
def test_the_inverse_gives_back_the_current_also_at_the_centre(a, b):
    y, i = a * GAP, b * I_0
    assert control_current(MAGNETS, y, force(y, i)) == pytest.approx(i, abs=1e-9)


def test_beyond_the_reachable_force_the_inverse_gives_the_strongest_current():
    y = 0.9 * GAP
    strongest = control_current(MAGNETS, y, -1e9)
    assert force(y, strongest) <= min(force(y, strongest + d) for d in (-0.01, 0.01))
