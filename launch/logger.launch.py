"""Starts the logger alone: it records every topic of the cell to a bag."""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import OUTPUT, RECORD, RT_PRIORITY, described, starting

OVERRIDES = {**OUTPUT, **RT_PRIORITY}


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros logger.launch.py`, and by cell.launch.py."""
    return described(RECORD, OVERRIDES, [starting("logger", OVERRIDES, only_if={"record": True})])
