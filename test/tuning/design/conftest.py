import dataclasses

import pytest

from scripts.stage_files import stage_scenario
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back


@pytest.fixture(scope="session")
def shipped():
    """The shipped stage with a stroke of a second and a half."""
    scenario = stage_scenario("shipped")
    motion = MotionParameters(stroke=0.06, speed=0.2, acceleration=1.0, settle=0.3, pause=0.5)
    stage = dataclasses.replace(scenario.description, motion=motion)
    return dataclasses.replace(scenario.on(stage), trajectory=Trajectory(forward_and_back(motion)))


@pytest.fixture(scope="session")
def infeasible():
    """The stage on which no gains have margins."""
    return stage_scenario("infeasible")
