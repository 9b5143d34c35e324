"""What the launch files share: a node's arguments, the parameters that they override, and where it is found by others.

It needs `launch` and `launch_ros`, and is imported by the files in launch/ only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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
_AS_SET = "as the parameters say"


class Override(NamedTuple):
    """A launch argument that, where it is given, wins over the file: its parameter, the type, and what it is."""

    parameter: str
    kind: type
    description: str


Overrides = Mapping[str, Override]
Chosen = dict[str, ParameterValue]
RT_PRIORITY: Overrides = {
    "rt_priority": Override("realtime.priority", int, f"SCHED_FIFO priority, 0 for none; empty: {_AS_SET}")
}
LAW: Overrides = {"law": Override("control.law", str, f"Control law; empty: {_AS_SET}")}
MAP: Overrides = {"map": Override("map.file", str, f"Survey file; empty: {_AS_SET}")}
HARDWARE: Overrides = {"hardware": Override("hardware", str, f"Machine, 'simulated' or 'can'; empty: {_AS_SET}")}
OUTPUT: Overrides = {"output": Override("output", str, f"Folder of the bag; empty: {_AS_SET}")}
OPCUA_USERS: Overrides = {"opcua_users": Override("opcua.users", str, f"File of the gateway's users; empty: {_AS_SET}")}
OF_ALL: Mapping[str, tuple[object, str]] = {
    "namespace": ("", "Namespace of all that is started"),
    "params_file": (PathJoinSubstitution([SHARE, "config", "straightcomp.yaml"]), "YAML file of parameters"),
}
"""Arguments of each launch file: default and description."""
RECORD: Mapping[str, tuple[object, str]] = {"record": ("true", "false: there is no logger, and no bag")}


def use_opcua(default: str) -> Mapping[str, tuple[object, str]]:
    """The argument that chooses between cell and gateway."""
    return {"use_opcua": (default, "true: the OPC UA gateway in the place of the cell, its client runs the cycles")}


def described(
    arguments: Mapping[str, tuple[object, str]], overrides: Overrides, actions: Iterable[object]
) -> LaunchDescription:
    """A launch file's content: its arguments, traffic kept on this computer, and what it starts.

    Args:
        arguments: besides those of all launch files: default and description of each.
        overrides: arguments that win over the file.
        actions: what it starts.
    """
    texts = {**OF_ALL, **arguments, **{name: ("", override.description) for name, override in overrides.items()}}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description, choices=_choices(default))
        for name, (default, description) in texts.items()
    ]
    # 2 kHz topics stay off the network unless somebody asks for it.
    on_this_computer = SetEnvironmentVariable(_DISCOVERY, EnvironmentVariable(_DISCOVERY, default_value="LOCALHOST"))
    return LaunchDescription([*declared, on_this_computer, *actions])


def starting(
    name: str,
    overrides: Overrides,
    *,
    only_if: Mapping[str, bool] | None = None,
    ends_all: bool = False,
    chosen: Callable[[LaunchContext], Chosen] = lambda context: {},
) -> OpaqueFunction:
    """Start a node.

    Args:
        name: of the node.
        overrides: arguments that win over the file.
        only_if: what these arguments, true or false, must be.
        ends_all: when this node has ended, all that was launched is shut down.
        chosen: further parameters, from the arguments.
    """

    def actions(context: LaunchContext) -> list[object]:
        if any(_is_true(context, argument) is not wanted for argument, wanted in (only_if or {}).items()):
            return []
        # Known only now: without an argument, the file (or the node's own default) has its say.
        given = {argument: LaunchConfiguration(argument).perform(context) for argument in overrides}
        parameters: list[object] = [
            {overrides[argument].parameter: ParameterValue(value, value_type=overrides[argument].kind)}
            for argument, value in given.items()
            if value
        ]
        more = chosen(context)
        node = Node(
            package=PACKAGE,
            executable=f"{name}_node",
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *parameters, *([more] if more else [])],
            output="screen",
        )
        if not ends_all:
            return [node]
        shutdown = EmitEvent(event=Shutdown(reason=f"the {name} has ended"))
        # Before the node: one that ends at once (a wrong parameter) must not end unseen.
        return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=[shutdown])), node]

    return OpaqueFunction(function=actions)


def without_a_logger(context: LaunchContext) -> Chosen:
    """Nodes for who waits for them all, where there is no recording."""
    if _is_true(context, "record"):
        return {}
    return {"nodes": ParameterValue("driver feedforward controller", value_type=str)}


def _choices(default: object) -> list[str] | None:
    return _CHOICES if default in _CHOICES else None


def _is_true(context: LaunchContext, argument: str) -> bool:
    return LaunchConfiguration(argument).perform(context) == "true"
