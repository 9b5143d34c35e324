import pytest

from straightcomp_ros.control.laws import ControlParameters
from straightcomp_ros.control.sliding_mode import SlidingDesign, closed_loop_poles, reaching_bound
from straightcomp_ros.model.actuator import stiffness_errors
from straightcomp_ros.parameters.declaration import ParameterError, from_mapping
from straightcomp_ros.stage.description import StageParameters

DESIGN = SlidingDesign()


def stage(travel=25e-6, friction=0.645):
    return from_mapping(StageParameters, {"guide.travel": travel, "friction.static": friction})


STAGE = stage()


def test_the_poles_are_those_of_the_paper():
    poles = sorted(closed_loop_poles(DESIGN, STAGE), key=lambda p: (p.real, p.imag))
    assert poles[2] == pytest.approx(-100.0, abs=1e-6)
    assert poles[0] == pytest.approx(-175.9 - 131.9j, abs=0.1)
    assert poles[1] == pytest.approx(-175.9 + 131.9j, abs=0.1)


def test_the_reaching_bound_is_friction_over_mass_plus_margin_near_the_centre():
    friction = STAGE.friction.static / STAGE.platform.mass + DESIGN.gamma
    bound = reaching_bound(DESIGN, STAGE)
    assert friction < bound < 1.02 * friction
    assert reaching_bound(DESIGN, stage(friction=1.8)) > bound


def test_the_reaching_bound_is_that_of_equation_11_where_the_stiffness_errors_count():
    actuator, mass = STAGE.actuator, STAGE.platform.mass
    travel = 0.3 * actuator.air_gap
    position = actuator.position_stiffness / mass * travel
    friction = STAGE.friction.static / mass
    hold = (position + friction) * mass / actuator.current_stiffness / actuator.bias_current
    m_y, m_i = stiffness_errors(0.3, hold)
    expected = (m_i * position + m_y * position + friction + DESIGN.gamma) / (1.0 - m_i)
    assert reaching_bound(DESIGN, stage(travel=travel)) == pytest.approx(expected, rel=1e-12)
    # Each part is one that shows.
    assert min(m_i * position, m_y * position, friction, DESIGN.gamma) > 0.01 * expected


def test_where_the_gain_error_reaches_one_no_rho_suffices():
    assert reaching_bound(DESIGN, stage(travel=0.6 * 1.5e-3)) == float("inf")


def test_a_rho_below_the_reaching_bound_is_refused_unless_it_is_wanted():
    with pytest.raises(ParameterError, match=r"control\.smc\.rho.*0\.2.*\(11\).*> 0\.31"):
        ControlParameters(law="smc", smc=SlidingDesign(rho=0.2)).check(STAGE)
    ControlParameters(law="smc", smc=SlidingDesign(rho=0.2, enforce_reaching=False)).check(STAGE)
    ControlParameters(law="linear", smc=SlidingDesign(rho=0.2)).check(STAGE)
