"""Starts the feedforward alone: it answers each encoder sample with the reference that the map gives."""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import IN_THE_LOOP, launched


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros feedforward.launch.py`, and by cell.launch.py."""
    return launched("feedforward", *IN_THE_LOOP["feedforward"])
