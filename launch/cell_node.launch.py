"""Starts the cell alone: it waits for the other nodes, asks for the motion and ends with the evaluation.

When the cell has ended, everything that was launched with it is shut down. With `use_opcua:=true` it is not started:
two would move the stage and switch the amplifier.
"""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import launched


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros cell_node.launch.py`, and by cell.launch.py."""
    return launched(
        "cell", "rt_priority", only_if={"use_opcua": False}, runs_cycle=True, record="true", use_opcua="false"
    )
