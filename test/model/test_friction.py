import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.friction import LuGreParameters, bristle_after, friction_force, stribeck_force
from straightcomp_ros.parameters.declaration import ParameterError

PARAMETERS = LuGreParameters()
LUGRE = PARAMETERS.constants()


@pytest.mark.parametrize("velocity", [1e-6, 5e-6, 2e-5, 1e-4, 1e-2, -3e-5])
def test_sliding_long_enough_gives_the_stribeck_curve_plus_viscous_friction(velocity):
    bristle = bristle_after(LUGRE, 0.0, velocity, 100.0)
    steady = math.copysign(stribeck_force(LUGRE, velocity), velocity) + PARAMETERS.viscous * velocity
    assert friction_force(LUGRE, bristle, velocity) == pytest.approx(steady, rel=1e-9)


def test_the_stribeck_curve_falls_from_static_to_coulomb_friction():
    assert stribeck_force(LUGRE, 0.0) == PARAMETERS.static
    assert stribeck_force(LUGRE, 1.0) == pytest.approx(PARAMETERS.coulomb)
    curve = [stribeck_force(LUGRE, v) for v in np.linspace(0, 1e-4, 50)]
    assert all(later <= earlier for earlier, later in itertools.pairwise(curve))


def test_before_sliding_the_bristles_are_a_spring():
    # A displacement of a hundredth of the break-away deflection, slowly.
    displacement = 0.01 * PARAMETERS.static / PARAMETERS.bristle_stiffness
    bristle = bristle_after(LUGRE, 0.0, displacement / 1.0, 1.0)
    assert LUGRE.bristle_stiffness * bristle / displacement == pytest.approx(PARAMETERS.bristle_stiffness, rel=0.01)


@given(st.floats(-1.0, 1.0), st.floats(0, 1.0))
def test_bristles_never_deflect_beyond_break_away(velocity, duration):
    limit = PARAMETERS.static / PARAMETERS.bristle_stiffness
    assert abs(bristle_after(LUGRE, 0.9 * limit, velocity, duration)) <= limit * (1 + 1e-12)


@given(st.floats(-0.1, 0.1), st.floats(1e-6, 1e-2))
def test_two_half_steps_of_the_bristle_are_one_whole_step(velocity, duration):
    start = 2e-7
    whole = bristle_after(LUGRE, start, velocity, duration)
    half = bristle_after(LUGRE, start, velocity, duration / 2)
    assert bristle_after(LUGRE, half, velocity, duration / 2) == pytest.approx(whole, rel=1e-9, abs=1e-18)


def test_static_friction_below_coulomb_friction_is_refused():
    with pytest.raises(ParameterError, match=r"static.*0\.5.*>= 0\.6"):
        LuGreParameters(coulomb=0.6, static=0.5)
