"""Starts the logger alone: it records every topic of the cell to a bag."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS = [FindPackageShare("straightcomp_ros"), "config", "straightcomp.yaml"]


def _node(context: LaunchContext) -> list[Node]:
    # Known only now: without the argument, the file (or the node's own default) has its say.
    output = LaunchConfiguration("output").perform(context)
    chosen = [{"output": ParameterValue(output, value_type=str)}] if output else []
    return [
        Node(
            package="straightcomp_ros",
            executable="logger_node",
            name="logger",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *chosen],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros logger.launch.py`."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            DeclareLaunchArgument(
                "params_file", default_value=PathJoinSubstitution(PARAMETERS), description="YAML file of parameters"
            ),
            DeclareLaunchArgument(
                "output", default_value="", description="Folder of the bag; empty: as the parameters say"
            ),
            OpaqueFunction(function=_node),
        ]
    )
