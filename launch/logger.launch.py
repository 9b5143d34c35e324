"""Starts the logger alone: it records the run to a bag; docs/bags.md says which topics."""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import launched


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros logger.launch.py`, and by cell.launch.py."""
    return launched("logger", "output", "rt_priority", only_if={"record": True}, record="true")
