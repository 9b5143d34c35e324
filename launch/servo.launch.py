"""Starts driver, feedforward and controller in one process with one loop.

`ros2 launch straightcomp_ros servo.launch.py hardware:=can law:=smc`.
"""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import launched_composed


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros servo.launch.py`, and by cell.launch.py."""
    return launched_composed()
