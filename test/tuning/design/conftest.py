import pytest
from motions import moving

from scripts.stage_files import stage_scenario
from straightcomp_ros.model.motion import MotionParameters
from straightcomp_ros.offline.scenario import Scenario


def short(scenario: Scenario, stroke: float = 0.06) -> Scenario:
    """The stage with a stroke of a second and a half."""
    return moving(scenario, MotionParameters(stroke=stroke, speed=0.2, acceleration=1.0, settle=0.3, pause=0.5))


@pytest.fixture(scope="session")
def shipped() -> Scenario:
    """The shipped stage, short."""
    return short(stage_scenario("shipped"))


@pytest.fixture(scope="session")
def fine() -> Scenario:
    """The stage with an encoder of 5 nm, short."""
    return short(stage_scenario("fine_encoder"))


@pytest.fixture(scope="session")
def infeasible() -> Scenario:
    """The stage on which no gains have margins."""
    return stage_scenario("infeasible")
