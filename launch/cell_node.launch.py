"""Starts the cell alone: it waits for the other nodes, asks for the motion and ends with the evaluation.

When the cell has ended, everything that was launched with it is shut down.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PARAMETERS = [FindPackageShare("straightcomp_ros"), "config", "straightcomp.yaml"]


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros cell_node.launch.py`, and by cell.launch.py."""
    cell = Node(
        package="straightcomp_ros",
        executable="cell_node",
        name="cell",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file")],
        output="screen",
    )
    shutdown = EmitEvent(event=Shutdown(reason="the cell has ended"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            DeclareLaunchArgument(
                "params_file", default_value=PathJoinSubstitution(PARAMETERS), description="YAML file of parameters"
            ),
            # Before the node: a cell that ends at once (a wrong parameter) must not end unseen.
            RegisterEventHandler(OnProcessExit(target_action=cell, on_exit=[shutdown])),
            cell,
        ]
    )
