"""What the files in launch/ share: a node's arguments, and the parameters that they override. Only they import it."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from straightcomp_ros.contract import PACKAGE

SHARE = FindPackageShare(PACKAGE)
_DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_CHOICES = ["true", "false"]
"""Of an argument whose default is one of them: `True` or `1` are refused, and taken for neither."""


class Override(NamedTuple):
    """What a launch argument means that, where it is given, wins over the file of parameters."""

    parameter: str
    kind: type
    description: str


Overrides = Mapping[str, Override]
Arguments = Mapping[str, tuple[object, str]]
"""By name: default and description."""


def _override(argument: str, parameter: str, what: str, kind: type = str) -> Overrides:
    return {argument: Override(parameter, kind, f"{what}; empty: as the parameters say")}


RT_PRIORITY = _override("rt_priority", "realtime.priority", "SCHED_FIFO priority, 0 for none", int)
LAW = _override("law", "control.law", "Control law")
MAP = _override("map", "map.file", "Survey file")
HARDWARE = _override("hardware", "hardware", "Machine, 'simulated' or 'can'")
OUTPUT = _override("output", "output", "Folder of the bag")
OPCUA_USERS = _override("opcua_users", "opcua.users", "File of the gateway's users")
OF_ALL: Arguments = {
    "namespace": ("", "Namespace of all that is started"),
    "params_file": (PathJoinSubstitution([SHARE, "config", "straightcomp.yaml"]), "YAML file of parameters"),
}
"""Arguments of each launch file."""
RECORD: Arguments = {"record": ("true", "false: there is no logger, and no bag")}


def use_opcua(default: str) -> Arguments:
    """The argument that chooses between cell and gateway."""
    return {"use_opcua": (default, "true: the OPC UA gateway in the place of the cell, its client runs the cycles")}


def described(arguments: Arguments, overrides: Overrides, actions: Iterable[object]) -> LaunchDescription:
    """A launch file's content: its arguments besides those of all launch files, and the actions that start nodes."""
    texts = {**OF_ALL, **arguments, **{name: ("", override.description) for name, override in overrides.items()}}
    declared = [
        DeclareLaunchArgument(
            name, default_value=default, description=text, choices=_CHOICES if default in _CHOICES else None
        )
        for name, (default, text) in texts.items()
    ]
    # 2 kHz topics stay off the network unless somebody asks for it.
    on_this_computer = SetEnvironmentVariable(_DISCOVERY, EnvironmentVariable(_DISCOVERY, default_value="LOCALHOST"))
    return LaunchDescription([*declared, on_this_computer, *actions])


def starting(
    name: str, overrides: Overrides, *, only_if: Mapping[str, bool] | None = None, runs_cycle: bool = False
) -> OpaqueFunction:
    """Start the node ``name``, if the arguments ``only_if`` have these values.

    One that ``runs_cycle`` waits for all others (``record:=false``: but the logger); its end shuts all down.
    """

    def actions(context: LaunchContext) -> list[object]:
        if any(_is_true(context, argument) is not wanted for argument, wanted in (only_if or {}).items()):
            return []
        # Known only now. An argument that is empty leaves the parameter to the file, or to the node's own default.
        given = {name: LaunchConfiguration(name).perform(context) for name in overrides}
        parameters = {
            overrides[name].parameter: ParameterValue(value, value_type=overrides[name].kind)
            for name, value in given.items()
            if value
        }
        if runs_cycle and not _is_true(context, "record"):
            parameters["nodes"] = ParameterValue("driver feedforward controller", value_type=str)
        node = Node(
            package=PACKAGE,
            executable=f"{name}_node",
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *([parameters] if parameters else [])],
            output="screen",
        )
        if not runs_cycle:
            return [node]
        shutdown = EmitEvent(event=Shutdown(reason=f"the {name} has ended"))
        # Before the node: one that ends at once (a wrong parameter) must not end unseen.
        return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=[shutdown])), node]

    return OpaqueFunction(function=actions)


def _is_true(context: LaunchContext, argument: str) -> bool:
    return LaunchConfiguration(argument).perform(context) == "true"
