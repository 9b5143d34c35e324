import numpy as np
import pytest

from straightcomp_ros.control.design import (
    NominalPlant,
    SlidingDesign,
    closed_loop_poles,
    reaching_bound,
    sampled_poles,
)
from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.parameters import ParameterError

DESIGN, NOMINAL = SlidingDesign(), NominalPlant()
LOOP = {"period": 5e-4, "delay": 2.5e-4, "amplifier_bandwidth": 500.0, "velocity_bandwidth": 1000.0}


def test_the_poles_are_those_of_the_paper():
    poles = sorted(closed_loop_poles(DESIGN, NOMINAL), key=lambda p: (p.real, p.imag))
    assert poles[2] == pytest.approx(-100.0, abs=1e-6)
    assert poles[0] == pytest.approx(-175.9 - 131.9j, abs=0.1)
    assert poles[1] == pytest.approx(-175.9 + 131.9j, abs=0.1)


def test_fast_sampling_without_lag_gives_the_continuous_poles():
    fast = sampled_poles(DESIGN, NOMINAL, period=1e-6, delay=0.0, amplifier_bandwidth=1e6, velocity_bandwidth=1e5)
    continuous = np.log(fast[np.abs(fast) > 0.99]) / 1e-6
    for pole in closed_loop_poles(DESIGN, NOMINAL):
        assert min(abs(continuous - pole)) < 0.01 * abs(pole)


def test_the_default_loop_is_stable_with_one_and_a_half_times_its_delay_and_with_its_boundary_layer():
    for delay in (0.0, 2.5e-4, 5e-4):
        poles = sampled_poles(
            DESIGN, NOMINAL, **{**LOOP, "delay": delay}, boundary_gain=DESIGN.rho / DESIGN.boundary_layer
        )
        assert max(abs(poles)) < 0.999


def test_a_boundary_layer_too_thin_for_the_delay_is_unstable():
    assert max(abs(sampled_poles(DESIGN, NOMINAL, **LOOP, boundary_gain=2000.0))) > 1.0


def test_a_delay_beyond_one_period_is_refused():
    with pytest.raises(ValueError, match=r"0\.0006"):
        sampled_poles(DESIGN, NOMINAL, **{**LOOP, "delay": 6e-4})


def test_the_reaching_bound_is_friction_over_mass_plus_margin_near_the_centre():
    friction = NOMINAL.friction / NOMINAL.mass + DESIGN.gamma
    bound = reaching_bound(DESIGN, NOMINAL)
    assert friction < bound < 1.02 * friction
    assert reaching_bound(DESIGN, NominalPlant(friction=1.8)) > bound


def test_where_the_gain_error_reaches_one_no_rho_suffices():
    assert reaching_bound(DESIGN, NominalPlant(travel=0.6 * 1.5e-3)) == float("inf")


def test_a_rho_below_the_reaching_bound_is_refused_unless_it_is_wanted():
    with pytest.raises(ParameterError, match=r"design\.rho.*0\.2.*\(11\).*> 0\.40"):
        ControlParameters(law="smc", design=SlidingDesign(rho=0.2))
    ControlParameters(law="smc", design=SlidingDesign(rho=0.2, enforce_reaching=False))
    ControlParameters(law="linear", design=SlidingDesign(rho=0.2))
