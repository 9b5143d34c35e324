"""Starts the controller alone."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS = [FindPackageShare("straightcomp_ros"), "config", "straightcomp.yaml"]


def _node(context: LaunchContext) -> list[Node]:
    # Known only now: without the argument, the file (or the node's own default) has its say.
    law = LaunchConfiguration("law").perform(context)
    chosen = [{"control.law": ParameterValue(law, value_type=str)}] if law else []
    return [
        Node(
            package="straightcomp_ros",
            executable="controller_node",
            name="controller",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *chosen],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros controller.launch.py`."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            DeclareLaunchArgument(
                "params_file", default_value=PathJoinSubstitution(PARAMETERS), description="YAML file of parameters"
            ),
            DeclareLaunchArgument("law", default_value="", description="Control law; empty: as the parameters say"),
            OpaqueFunction(function=_node),
        ]
    )
