"""What pushes a simulated platform, and how it rings."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.model.disturbances import (
    FORCE,
    FORCE_RATE,
    OFFSET,
    TIME,
    DisturbanceParameters,
    aim,
    disturbing_force,
    interpolated,
    locked_force,
)
from straightcomp_ros.model.friction import LuGreParameters, band_value
from straightcomp_ros.model.modes import (
    MODE_STATE,
    ModeParameters,
    ModesParameters,
    at_coil,
    at_encoder,
    off,
    push,
    yielding,
)
from straightcomp_ros.model.plant import PlantParameters, PlatformParameters, advance, plant_state
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping

MASS = 3.0


def constants(**values):
    given = from_mapping(DisturbanceParameters, {name.replace("__", "."): value for name, value in values.items()})
    return PlantParameters(disturbances=given.machine()).constants()


def test_mains_are_sines_of_the_frequency_and_its_multiples():
    k, state = constants(mains__force=0.3, mains__second=0.2, mains__third=0.1), plant_state()
    state[TIME] = 0.0123
    a = 2.0 * math.pi * 50.0 * 0.0123
    expected = 0.3 * math.sin(a) + 0.2 * math.sin(2 * a) + 0.1 * math.sin(3 * a)
    assert disturbing_force(k, state) == pytest.approx(expected)


def test_forces_over_x_are_cogging_cable_and_table(tmp_path):
    k = constants(cogging__force=0.5, cogging__pitch=0.02, cable__slope=2.0, cable__drag=0.3)
    there, back = locked_force(k, 0.113, 0.1), locked_force(k, 0.113, -0.1)
    assert there - back == pytest.approx(0.6)
    assert 0.5 * (there + back) == pytest.approx(0.5 * math.sin(2.0 * math.pi * 0.113 / 0.02) + 0.226)
    file = tmp_path / "force.csv"
    # Windows puts a byte order mark in front.
    file.write_text("x_m,force_n\n0.1,1\n0.2,3\n0.5,-1\n# measured\n", encoding="utf-8-sig")
    table = constants(force_file=str(file))
    assert [locked_force(table, x, 0.0) for x in (0.0, 0.15, 0.35, 0.9)] == pytest.approx([1.0, 2.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("rows", "named"),
    [("", "0 rows"), ("0,1\n", "1 rows"), ("0,1\n2,1\n1,2\n", "x_m 1 in row 3"), ("0,nan\n", "line 2")],
)
def test_a_table_of_force_that_does_not_serve_is_refused_by_name(rows, named, tmp_path):
    file = tmp_path / "force.csv"
    file.write_text(f"x_m,force_n\n{rows}")
    with pytest.raises(ParameterError, match=rf"force\.csv.*{named}.*allowed"):
        constants(force_file=str(file))


def test_what_disturbs_at_each_sample_is_that_of_its_equations():
    """In complex numbers: the vibration and its quadrature turn and decay; what is drawn keeps the RMS."""
    random = {"drift__current": 5e-3, "drift__time": 0.05, "vibration__acceleration": 0.2, "vibration__damping": 0.1}
    k, state = constants(seed=3, tilt=0.01, cable__drag=0.3, cable__slope=2.0, **random), plant_state()
    offset, vibration, x, force = 0.0, 0.0, 0.1, math.nan
    for n in range(50):
        seconds, last, x = (3e-4 if n else 0.0), x, 0.1 + 1e-7 * n * n
        aim(k, state, MASS, x, seconds)
        kept, decay = (math.exp(-seconds / 0.05), math.exp(-0.1 * 60.0 * math.pi * seconds)) if n else (0.0, 0.0)
        # Three streams of numbers, of which each sample takes one.
        drawn = [sum(band_value(3, 12 * n + 3 * stream + i) for i in range(3)) for stream in range(3)]
        offset = kept * offset + 5e-3 * math.sqrt(1.0 - kept**2) * drawn[0]
        turn = decay * cmath.exp(60j * math.pi * math.sqrt(1.0 - 0.1**2) * seconds)
        vibration = turn * vibration + 0.2 * math.sqrt(1.0 - decay**2) * complex(*drawn[1:])
        assert state[OFFSET] == pytest.approx(offset, rel=1e-9)
        speed = (x - last) / seconds if n else 0.0
        before = force if n else 2.0 * x + MASS * (9.80665 * math.sin(0.01) + vibration.real)
        force = 2.0 * x + 0.3 * math.tanh(speed / 1e-3) + MASS * (9.80665 * math.sin(0.01) + vibration.real)
        assert disturbing_force(k, state) == pytest.approx(before, rel=1e-9)
        state[FORCE] += seconds * state[FORCE_RATE]
        assert disturbing_force(k, state) == pytest.approx(force, rel=1e-9)


@pytest.mark.parametrize(
    "one",
    [
        *("mains.force", "mains.second", "mains.third", "cogging.force", "cable.slope", "cable.drag", "tilt"),
        *("drift.current", "vibration.acceleration", "interpolation.amplitude"),
    ],
)
def test_anything_that_disturbs_is_simulated(one):
    assert not DisturbanceParameters().machine().any
    assert from_mapping(DisturbanceParameters, {one: 1e-5}).machine().any


def test_the_encoder_interpolates_with_an_error_over_its_signal_period():
    k = constants(interpolation__amplitude=40e-9)
    assert interpolated(k, 5e-6) == pytest.approx(5e-6 + 40e-9)
    assert interpolated(k, 15e-6) == pytest.approx(15e-6 - 40e-9)


def rung(mode, participation, t):
    """What a mode adds where it takes part so to a free platform of 1 m/s, t s after the impulse."""
    w = 2.0 * math.pi * mode.frequency
    turning = w * math.sqrt(1.0 - mode.damping**2)
    return mode.coil * participation * math.exp(-mode.damping * w * t) * math.sin(turning * t) / turning


def test_a_platform_rings_as_its_modes_say():
    free = LuGreParameters(coulomb=1e-12, static=1e-12, bristle_stiffness=1e-3, bristle_damping=0.0, viscous=0.0)
    modes = (ModeParameters(180.0, 0.01, 0.5, -2.0), ModeParameters(600.0, 0.02, 0.3, 0.3))
    plant = PlantParameters(
        PlatformParameters(modes=ModesParameters(*modes)), friction=free, encoder=EncoderParameters(y_resolution=1e-12)
    )
    k, impulse = plant.constants(), 1e-5
    state = plant_state(velocity=impulse)
    state[[MODE_STATE + 1, MODE_STATE + 3]] = [impulse * mode.coil for mode in modes]
    for n in range(1, 21):
        advance(k, state, 0.0, 0.0, 500_000)
        t = 5e-4 * n
        for place, at in (at_coil, "coil"), (at_encoder, "encoder"):
            later, now = (s + sum(rung(mode, getattr(mode, at), s) for mode in modes) for s in (t + 1e-8, t))
            assert place(k, state, 0) == pytest.approx(impulse * now, abs=1e-3 * impulse * t)
            assert place(k, state, 1) == pytest.approx(impulse * (later - now) / 1e-8, abs=2e-3 * impulse)


def test_a_push_at_the_coils_moves_mass_and_modes_by_their_participation_and_so_the_coils_themselves():
    modes = (ModeParameters(180.0, 0.01, 0.5, -2.0), ModeParameters(600.0, 0.02, 0.3, 0.7))
    k, state = (
        PlantParameters(PlatformParameters(modes=ModesParameters(*modes))).constants(),
        plant_state(velocity=1e-3),
    )
    push(k, state, 2e-3)
    assert state[[1, MODE_STATE + 1, MODE_STATE + 3]] == pytest.approx([3e-3, 1e-3, 6e-4])
    assert at_coil(k, state, 1) - 1e-3 == pytest.approx(2e-3 * yielding(k))
    assert np.count_nonzero(state) == 3


def test_a_force_bends_a_mode_by_its_participation():
    mode = ModeParameters(200.0, 0.5, 0.5, -2.0)
    tilted = replace(DisturbanceParameters(), tilt=0.01).machine()
    plant = PlantParameters(PlatformParameters(modes=ModesParameters(mode)), disturbances=tilted)
    k, state = plant.constants(), plant_state()
    aim(k, state, MASS, 0.0, 0.0)
    advance(k, state, 0.0, 0.0, 100_000_000)
    # Friction holds the coils: what gravity bends is what it pushes there beyond friction.
    pushed = (disturbing_force(k, state) - state[5]) / MASS
    assert state[18] == pytest.approx(0.5 * pushed / (2.0 * math.pi * 200.0) ** 2, rel=1e-3, abs=1e-12)
    assert at_encoder(k, state, 0) == pytest.approx(state[0] - 2.0 * state[18])


def test_a_mode_is_off_by_shares_of_its_uncertainty():
    mode = ModeParameters(200.0, 0.02, 0.5, -2.0, frequency_error=0.1, damping_factor=2.0, participation_error=0.5)
    one = off(mode, 0.5, -1.0, 0.4)
    assert (one.frequency, one.damping, one.residue, one.encoder) == pytest.approx((210.0, 0.01, -1.2, -2.0))
    assert off(mode, -1.0, 1.0, -1.0).damping == pytest.approx(0.04)


def test_a_mode_that_may_be_damped_more_than_swings_swings_still():
    mode = ModeParameters(200.0, 0.6, damping_factor=2.0)
    for share in (1.0, 0.9):
        assert np.isfinite(off(mode, 0.0, share, 0.0).constants()).all()
