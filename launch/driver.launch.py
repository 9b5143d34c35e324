"""Starts the driver alone: the stage and its amplifier, or the simulation of both."""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import IN_THE_LOOP, launched


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros driver.launch.py`, and by cell.launch.py."""
    return launched("driver", *IN_THE_LOOP["driver"])
