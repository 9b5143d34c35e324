"""Starts the whole cell on this computer: driver, feedforward, controller, logger and cell.

`ros2 launch straightcomp_ros cell.launch.py law:=linear output:=/tmp/run1`. It ends when the cell has ended.
With `use_opcua:=true` the OPC UA gateway is there in the place of the cell: its client runs the cycles, and the launch
ends when the gateway has ended.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, SetEnvironmentVariable
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("straightcomp_ros")
ARGUMENTS = {
    "namespace": ("", "Namespace of all nodes"),
    "params_file": (PathJoinSubstitution([SHARE, "config", "straightcomp.yaml"]), "YAML file of parameters"),
    "law": ("", "Control law; empty: as the parameters say"),
    "map": ("", "Survey file; empty: as the parameters say"),
    "hardware": ("", "Machine, 'simulated' or 'can'; empty: as the parameters say"),
    "record": ("true", "false: no bag"),
    "rt_priority": ("", "SCHED_FIFO priority of all nodes, 0 for none; empty: as the parameters say"),
    "use_opcua": ("false", "true: the OPC UA gateway in the place of the cell, its client runs the cycles"),
    "opcua_users": ("", "File of the gateway's users; empty: as the parameters say"),
    "output": ("", "Folder of the bag; empty: as the parameters say"),
}
DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"


def _include(name: str) -> IncludeLaunchDescription:
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, "launch", f"{name}.launch.py"])),
        launch_arguments={argument: LaunchConfiguration(argument) for argument in ARGUMENTS}.items(),
    )


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros cell.launch.py`."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    # 2 kHz topics stay off the network unless somebody asks for it.
    on_this_computer = SetEnvironmentVariable(DISCOVERY, EnvironmentVariable(DISCOVERY, default_value="LOCALHOST"))
    nodes = [_include(name) for name in ("driver", "feedforward", "controller", "logger", "cell_node", "opcua")]
    return LaunchDescription([*declared, on_this_computer, *nodes])
