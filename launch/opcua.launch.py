"""Starts the OPC UA gateway alone: its clients run the cycle. Needs the extra `opcua`.

When the gateway has ended, everything that was launched with it is shut down.
"""

from launch import LaunchDescription

from straightcomp_ros.runtime.launch_files import launched


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros opcua.launch.py`, and by cell.launch.py."""
    return launched(
        "opcua",
        "opcua_users",
        "rt_priority",
        only_if={"use_opcua": True},
        runs_cycle=True,
        record="true",
        use_opcua="true",
    )
