"""Starts the cell alone: it waits for the other nodes, asks for the motion and ends with the evaluation.

When the cell has ended, everything that was launched with it is shut down.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS = [FindPackageShare("straightcomp_ros"), "config", "straightcomp.yaml"]


def _cell(context: LaunchContext) -> list[RegisterEventHandler | Node]:
    if LaunchConfiguration("use_opcua").perform(context) == "true":
        # Two would move the stage and switch the amplifier: the gateway's client runs the cycles.
        return []
    chosen = []
    priority = LaunchConfiguration("rt_priority").perform(context)
    if priority:
        chosen.append({"realtime.priority": ParameterValue(priority, value_type=int)})
    if LaunchConfiguration("record").perform(context) == "false":
        # The cell must not wait for a logger that is not started.
        chosen.append({"nodes": ParameterValue("driver feedforward controller", value_type=str)})
    cell = Node(
        package="straightcomp_ros",
        executable="cell_node",
        name="cell",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), *chosen],
        output="screen",
    )
    shutdown = EmitEvent(event=Shutdown(reason="the cell has ended"))
    # Before the node: a cell that ends at once (a wrong parameter) must not end unseen.
    return [RegisterEventHandler(OnProcessExit(target_action=cell, on_exit=[shutdown])), cell]


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros cell_node.launch.py`, and by cell.launch.py."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            DeclareLaunchArgument(
                "params_file", default_value=PathJoinSubstitution(PARAMETERS), description="YAML file of parameters"
            ),
            DeclareLaunchArgument("record", default_value="true", description="false: there is no logger"),
            DeclareLaunchArgument("use_opcua", default_value="false", description="true: do not start it"),
            DeclareLaunchArgument(
                "rt_priority", default_value="", description="SCHED_FIFO priority; empty: as the parameters say"
            ),
            OpaqueFunction(function=_cell),
        ]
    )
