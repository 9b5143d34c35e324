"""Starts the feedforward alone: it answers each encoder sample with the reference that the map gives."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS = [FindPackageShare("straightcomp_ros"), "config", "straightcomp.yaml"]
OVERRIDES = {
    "map": ("map.file", str, "Survey file; empty: as the parameters say"),
    "rt_priority": ("realtime.priority", int, "SCHED_FIFO priority, 0 for none; empty: as the parameters say"),
}
"""Launch arguments that win over the file: the parameter of each, its type, and what it is."""


def _node(context: LaunchContext) -> list[Node]:
    # Known only now: without an argument, the file (or the node's own default) has its say.
    given = {name: LaunchConfiguration(name).perform(context) for name in OVERRIDES}
    chosen = [
        {OVERRIDES[name][0]: ParameterValue(value, value_type=OVERRIDES[name][1])}
        for name, value in given.items()
        if value
    ]
    return [
        Node(
            package="straightcomp_ros",
            executable="feedforward_node",
            name="feedforward",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *chosen],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros feedforward.launch.py`."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            DeclareLaunchArgument(
                "params_file", default_value=PathJoinSubstitution(PARAMETERS), description="YAML file of parameters"
            ),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, (_, _, description) in OVERRIDES.items()
            ),
            OpaqueFunction(function=_node),
        ]
    )
