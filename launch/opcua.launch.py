"""Starts the OPC UA gateway alone: its clients run the cycle. Needs the extra `opcua`.

When the gateway has ended, everything that was launched with it is shut down.
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
OVERRIDES = {
    "opcua_users": ("opcua.users", str, "File of the gateway's users; empty: as the parameters say"),
    "rt_priority": ("realtime.priority", int, "SCHED_FIFO priority, 0 for none; empty: as the parameters say"),
}
"""Launch arguments that win over the file: the parameter of each, its type, and what it is."""


def _gateway(context: LaunchContext) -> list[RegisterEventHandler | Node]:
    if LaunchConfiguration("use_opcua").perform(context) != "true":
        return []
    # Known only now: without an argument, the file (or the node's own default) has its say.
    given = {name: LaunchConfiguration(name).perform(context) for name in OVERRIDES}
    chosen = [
        {OVERRIDES[name][0]: ParameterValue(value, value_type=OVERRIDES[name][1])}
        for name, value in given.items()
        if value
    ]
    if LaunchConfiguration("record").perform(context) == "false":
        # The gateway must not wait for a logger that is not started.
        chosen.append({"nodes": ParameterValue("driver feedforward controller", value_type=str)})
    gateway = Node(
        package="straightcomp_ros",
        executable="opcua_node",
        name="opcua",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), *chosen],
        output="screen",
    )
    shutdown = EmitEvent(event=Shutdown(reason="the OPC UA gateway has ended"))
    # Before the node: a gateway that ends at once (the extra is missing) must not end unseen.
    return [RegisterEventHandler(OnProcessExit(target_action=gateway, on_exit=[shutdown])), gateway]


def generate_launch_description() -> LaunchDescription:
    """Called by `ros2 launch straightcomp_ros opcua.launch.py`, and by cell.launch.py."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node"),
            DeclareLaunchArgument(
                "params_file", default_value=PathJoinSubstitution(PARAMETERS), description="YAML file of parameters"
            ),
            DeclareLaunchArgument("use_opcua", default_value="true", description="true: start it"),
            DeclareLaunchArgument("record", default_value="true", description="false: there is no logger"),
            *(
                DeclareLaunchArgument(name, default_value="", description=description)
                for name, (_, _, description) in OVERRIDES.items()
            ),
            OpaqueFunction(function=_gateway),
        ]
    )
