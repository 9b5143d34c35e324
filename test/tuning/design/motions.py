"""Stages with another motion."""

import dataclasses

from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.offline.scenario import Scenario


def moving(scenario: Scenario, motion: MotionParameters) -> Scenario:
    """The stage with another motion."""
    stage = dataclasses.replace(scenario.description, motion=motion)
    return dataclasses.replace(scenario.on(stage), trajectory=Trajectory(forward_and_back(motion)))
