"""Starts the controller alone."""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import IN_THE_LOOP, launched


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros controller.launch.py`, and by cell.launch.py."""
    return launched("controller", *IN_THE_LOOP["controller"])
