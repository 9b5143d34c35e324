"""What no row of docs/paper.md says of the figures: limits against their closed forms, and where laws may bring back.

`test_reproduce_command.py` compares the rows.
"""

from dataclasses import replace

import numpy as np
import pytest

from straightcomp_ros.control.laws import LAWS
from straightcomp_ros.model.actuator import UNIT_GAIN_ERROR_LIMIT, ActuatorParameters, control_current
from straightcomp_ros.tuning.paper import gain_error, recovery
from straightcomp_ros.tuning.paper.friction import estimate_friction, stick_phases
from straightcomp_ros.tuning.paper.machine import AMPLITUDE, OMEGA, evaluated, follow_sine, fundamental
from straightcomp_ros.tuning.paper.surface import following_error_gain, lag

FAR = gain_error.FAR


def test_the_gain_error_limit_found_is_the_closed_form_and_beyond_it_the_error_exceeds_one():
    limit, largest = gain_error.gain_error_limit(), gain_error.largest_gain_error
    assert limit == pytest.approx(UNIT_GAIN_ERROR_LIMIT, abs=1e-9) == pytest.approx(0.3660, abs=5e-5)
    assert largest(limit - 1e-3) < 1.0 < largest(limit + 1e-3)


def test_released_far_out_the_unclamped_law_hits_the_stop_and_the_clamped_one_brings_the_platform_back(machine):
    free = gain_error.unclamped(machine)
    unclamped, clamped = (gain_error.released(one, FAR) for one in (free, free.with_limit(machine.bias)))
    assert unclamped.y[-1] == machine.stop and np.abs(unclamped.y).min() >= FAR * machine.gap
    assert abs(clamped.y[-1]) < 1e-2 * machine.gap and np.abs(clamped.command).max() <= machine.bias


def test_without_friction_the_sine_is_followed_with_the_lag_of_equation_12_and_with_it_the_platform_sticks(machine):
    ideal = machine.idealised().with_law("linear").without_friction()
    response, design = evaluated(follow_sine(ideal)), ideal.control.smc
    amplitude = fundamental(response.time, response.reference - response.y)
    for expected in (following_error_gain(design, OMEGA) * AMPLITUDE, lag(design) * OMEGA * AMPLITUDE):
        assert amplitude == pytest.approx(expected, rel=0.01)
    run = evaluated(follow_sine(machine.with_law("linear")))
    sticks = stick_phases(run, machine.plant.friction.coulomb)
    # Once at each reversal.
    assert len(sticks) == 4 and np.abs(run.reference[sticks[:, 0]]).min() > 0.95 * AMPLITUDE


@pytest.fixture(scope="module")
def data(machine):
    return recovery.regions(machine, points=21)


@pytest.mark.parametrize("a", [-0.7, 0.0, 0.4])
def test_the_physical_limit_is_what_full_current_does_in_a_machine_without_lag_and_friction(machine, a):
    """The closed form is an integral of (2); the simulation knows nothing of it."""
    drive = replace(machine.plant.drive, bandwidth=1e6, delay=0.0)
    plant, stage = replace(machine.plant, drive=drive), replace(machine.stage, rate=100_000, drive=drive)
    ideal, y = replace(machine, plant=plant, stage=stage).without_friction(), a * machine.gap
    slower, faster = (factor * recovery.fastest_outward(ideal, y) for factor in (0.99, 1.01))
    assert recovery.least_peak(ideal, y, slower) < ideal.stop < recovery.least_peak(ideal, y, faster)
    assert recovery.possible(ideal, y, slower) and not recovery.possible(ideal, y, faster)


@pytest.mark.parametrize("law", LAWS)
def test_every_law_recovers_from_fig_4_and_not_from_beyond_the_stop_nor_from_where_the_amplifier_cannot(data, law):
    one = data.machine.with_law(law)
    assert recovery.recovers(one, FAR * one.gap) and not recovery.recovers(one, 1.05 * one.stop)
    leaves, back = data.back(recovery.FULL_CURRENT), data.back(law)
    assert 0 < back.sum() < leaves.sum() < data.possible.sum()
    assert not (back & ~leaves).any() and not (leaves & ~data.possible).any()


def test_what_is_mirrored_is_what_is_computed(data):
    row, column = 7, 12
    y, velocity = data.positions[column], data.velocities[row]
    computed = recovery.peak(data.machine.with_law("smc_observer"), y, velocity)
    assert velocity < 0.0 and np.isfinite(computed)
    assert data.peaks["smc_observer"][row, column] == pytest.approx(computed, abs=1e-6)


def test_a_known_friction_is_found_again_through_equations_1_and_2():
    rate, mass, magnets, inner = 2000.0, 3.0, ActuatorParameters(), slice(100, -100)
    t = np.arange(4000) / rate
    y = AMPLITUDE * np.sin(OMEGA * t)
    friction = 0.6 * np.tanh(y / 20e-6)
    force = friction - mass * OMEGA**2 * y
    current = np.array([control_current(magnets.constants(), *pair) for pair in zip(y, force, strict=True)])
    velocity, found = estimate_friction(y, current, rate=rate, mass=mass, actuator=magnets)
    np.testing.assert_allclose(found[inner], friction[inner], atol=1e-4)
    np.testing.assert_allclose(velocity[inner], AMPLITUDE * OMEGA * np.cos(OMEGA * t)[inner], atol=1e-8)
