import dataclasses
import math

import numpy as np
import pytest

from straightcomp_ros.model.actuator import ActuatorParameters, control_current
from straightcomp_ros.model.friction import LuGreParameters
from straightcomp_ros.model.plant import (
    SUBSTEP_NS,
    Plant,
    PlantParameters,
    PlantState,
    PlatformParameters,
    _from_array,
    advance,
    as_array,
)

NO_FRICTION = LuGreParameters(
    coulomb=1e-12, static=1e-12, bristle_stiffness=1e-3, bristle_damping=0.0, viscous=0.0, stribeck_velocity=1.0
)
FREE = PlantParameters(friction=NO_FRICTION)
STICKY = PlantParameters()


def run(
    parameters: PlantParameters, state: PlantState, command: float, seconds: float, bias: float = 1.0
) -> PlantState:
    array = np.array(state)
    advance(as_array(parameters.constants()), array, bias, command, round(seconds * 1e9))
    return PlantState(*array)


def energy(plant: Plant, state: PlantState) -> float:
    """Kinetic energy plus the magnets' potential at the present currents and the bristles', in J.

    The potential of (2) at constant currents is −(μ0N²A/4) [i₁²/(y0−y) + i₂²/(y0+y)].
    """
    near = (state.bias + state.control) ** 2 / (plant.actuator.air_gap - state.y)
    far = (state.bias - state.control) ** 2 / (plant.actuator.air_gap + state.y)
    bristles = 0.5 * plant.lugre.bristle_stiffness * state.bristle**2
    return 0.5 * plant.mass * state.velocity**2 - plant.actuator.force_coefficient * (near + far) + bristles


def test_energy_is_conserved_where_there_is_no_friction():
    # A wide swing: 20 µm/s toward the centre, against the negative stiffness, between turning points.
    # Currents other than one ampere, which is its own square.
    start = PlantState(y=2e-4, velocity=-0.022, control=0.005, bias=1.1)
    constants = FREE.constants()
    before = energy(constants, start)
    kinetic = 0.5 * FREE.platform.mass * start.velocity**2
    state = start
    for _ in range(40):
        state = run(FREE, state, 0.005, 1e-3, bias=1.1)
        assert abs(energy(constants, state) - before) < 1e-5 * kinetic
    assert abs(state.y - start.y) > 1e-4  # it did move


def test_without_friction_the_platform_leaves_the_centre_with_the_open_loop_pole():
    pole = math.sqrt(FREE.actuator.position_stiffness / FREE.platform.mass)
    start = PlantState(y=1e-9, velocity=1e-9 * pole, bias=1.0)
    after = run(FREE, start, 0.0, 0.05)
    assert after.y == pytest.approx(1e-9 * math.exp(pole * 0.05), rel=1e-4)


def test_the_integration_is_of_second_order():
    start = PlantState(y=3e-4, velocity=-0.02, bias=1.0)
    constants = as_array(FREE.constants())

    def position(step_ns: int) -> float:
        state = np.array(start)
        for _ in range(20_000_000 // step_ns):
            advance(constants, state, 1.0, 0.05, step_ns)
        return state[0]

    # One call of a duration below SUBSTEP_NS is one substep.
    exact = position(SUBSTEP_NS // 100)
    coarse, fine = position(SUBSTEP_NS) - exact, position(SUBSTEP_NS // 2) - exact
    assert coarse / fine == pytest.approx(4.0, rel=0.1)


def test_the_holding_current_is_an_equilibrium():
    y = 1e-5
    current = control_current(FREE.actuator.constants(), y, 0.0)
    after = run(FREE, PlantState(y=y, control=current, bias=1.0), current, 0.02)
    assert abs(after.y - y) < 1e-12
    # The constant stiffnesses of (3) give the same current to first order.
    assert current == pytest.approx(-FREE.actuator.position_stiffness / FREE.actuator.current_stiffness * y, rel=1e-3)


def test_friction_holds_the_platform_against_the_negative_stiffness():
    # 0.03 N of magnetic force, far below break-away: the bristles deflect by F / (σ0 − K_y) and hold.
    after = run(STICKY, PlantState(y=1e-6, bias=1.0), 0.0, 0.5)
    force = STICKY.actuator.position_stiffness * 1e-6
    deflection = force / (STICKY.friction.bristle_stiffness - STICKY.actuator.position_stiffness)
    assert after.y - 1e-6 == pytest.approx(deflection, rel=0.1)
    assert abs(after.velocity) < 1e-8


def test_a_force_beyond_break_away_moves_the_platform():
    current = 1.5 * STICKY.friction.static / STICKY.actuator.current_stiffness
    assert run(STICKY, PlantState(bias=1.0), current, 0.1).y > 1e-5


def test_friction_takes_energy_away():
    constants = STICKY.constants()
    state = PlantState(velocity=1e-2, bias=0.0)
    last = energy(constants, state)
    for _ in range(100):
        state = run(STICKY, state, 0.0, 1e-3, bias=0.0)
        now = energy(constants, state)
        assert now <= last * (1 + 1e-9)
        last = now
    assert abs(state.velocity) < 1e-4


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_platform_stays_between_its_stops(side):
    after = run(FREE, PlantState(y=side * 1e-3, bias=1.0), 0.0, 1.0)
    assert after.y == pytest.approx(side * FREE.platform.stop)
    # With the bias off and a little push it comes back from there.
    pushed = run(FREE, after._replace(bias=0.0, velocity=-side * 0.01), 0.0, 0.02, bias=0.0)
    assert abs(pushed.y) < FREE.platform.stop - 1e-4


def test_the_amplifier_is_of_first_order():
    tau = 1.0 / (2 * math.pi * STICKY.drive.bandwidth)
    after = run(STICKY, PlantState(bias=1.0), 0.1, tau)
    assert after.control == pytest.approx(0.1 * (1 - math.exp(-1)), rel=1e-6)


def test_with_the_amplifier_off_the_magnets_pull_to_no_side():
    after = run(FREE, PlantState(y=1e-4, bias=1.0, control=0.3), 0.0, 0.05, bias=0.0)
    assert after.magnetic_force == pytest.approx(0.0, abs=1e-6)


def test_the_reported_forces_are_those_of_the_state():
    state = run(STICKY, PlantState(y=1e-5, bias=1.0), 0.01, 0.0123)
    acceleration = (state.magnetic_force - state.friction_force) / STICKY.platform.mass
    later = run(STICKY, state, 0.01, 1e-6)
    assert (later.velocity - state.velocity) / 1e-6 == pytest.approx(acceleration, rel=0.02)


def test_splitting_a_stretch_of_time_at_a_substep_changes_nothing():
    whole, parts = np.array(PlantState(bias=1.0)), np.array(PlantState(bias=1.0))
    constants = as_array(STICKY.constants())
    advance(constants, whole, 1.0, 0.03, 20 * SUBSTEP_NS)
    for _ in range(2):
        advance(constants, parts, 1.0, 0.03, 5 * SUBSTEP_NS, 0.03, 5 * SUBSTEP_NS)
    np.testing.assert_allclose(parts, whole, rtol=1e-12)


def test_the_constants_of_the_plant_come_through_the_array_in_their_places():
    odd = PlantParameters(
        platform=PlatformParameters(mass=1.5, stop=1e-3),
        actuator=ActuatorParameters(turns=300.0, air_gap=1.4e-3, bias_current=0.8),
        friction=LuGreParameters(0.1, 0.2, 3e-5, 4e5, 500.0, 6.0),
    )
    plant = odd.constants()
    flat = as_array(plant)
    assert flat.tolist() == [
        plant.mass,
        plant.stop,
        plant.amplifier_rate,
        *plant.actuator,
        *plant.lugre,
        *plant.extension,
    ]
    assert dataclasses.astuple(odd.friction) == tuple(plant.lugre)
    assert _from_array(flat) == plant[:5] and len(set(flat[:12].tolist())) == 12
