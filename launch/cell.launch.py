"""Starts the whole cell on this computer: driver, feedforward, controller, logger and cell.

`ros2 launch straightcomp_ros cell.launch.py law:=linear output:=/tmp/run1`. It ends when the cell has ended.
With `composed:=true` driver, feedforward and controller run in one process.
With `use_opcua:=true` the OPC UA gateway is there in the place of the cell: its client runs the cycles, and the launch
ends when the gateway has ended.
"""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution

from straightcomp_ros.runtime.launch_files import OF_ALL, OVERRIDES, SHARE, described

CHOICES = {"record": "true", "use_opcua": "false"}
NODES = {
    **dict.fromkeys(("driver", "feedforward", "controller"), UnlessCondition(LaunchConfiguration("composed"))),
    "servo": IfCondition(LaunchConfiguration("composed")),
    **dict.fromkeys(("logger", "cell_node", "opcua")),
}


def _include(name: str) -> IncludeLaunchDescription:
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", f"{name}.launch.py"])),
        launch_arguments={
            argument: LaunchConfiguration(argument) for argument in (*OF_ALL, *CHOICES, *OVERRIDES)
        }.items(),
        condition=NODES[name],
    )


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros cell.launch.py`."""
    return described({**CHOICES, "composed": "false"}, OVERRIDES, [_include(name) for name in NODES])
