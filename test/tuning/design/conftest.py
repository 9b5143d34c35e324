import pytest
from motions import moving

from scripts.stage_files import stage_scenario
from straightcomp_ros.model.motion import MotionParameters


def short(scenario, stroke=0.06):
    """The stage with a stroke of a second and a half."""
    return moving(scenario, MotionParameters(stroke=stroke, speed=0.2, acceleration=1.0, settle=0.3, pause=0.5))


@pytest.fixture(scope="session")
def shipped():
    """The shipped stage, short."""
    return short(stage_scenario("shipped"))


@pytest.fixture(scope="session")
def fine():
    """The stage with an encoder of 5 nm, short."""
    return short(stage_scenario("fine_encoder"))


@pytest.fixture(scope="session")
def infeasible():
    """The stage on which no gains have margins."""
    return stage_scenario("infeasible")
