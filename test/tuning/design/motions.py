"""Stages with another motion."""

import dataclasses

from straightcomp_ros.model.motion import Trajectory, forward_and_back


def moving(scenario, motion):
    """The stage with another motion."""
    stage = dataclasses.replace(scenario.description, motion=motion)
    return dataclasses.replace(scenario.on(stage), trajectory=Trajectory(forward_and_back(motion)))
