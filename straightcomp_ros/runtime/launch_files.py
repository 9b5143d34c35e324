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
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.parameters.parameter_file import files_beside, read_parameter_file

SHARE = FindPackageShare(PACKAGE)
_DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_CHOICES = ["true", "false"]
"""Values of a Boolean argument; others, such as `True` or `1`, are refused."""


class Override(NamedTuple):
    """A parameter that a launch argument sets; if given, the argument takes precedence over the parameter file."""

    parameter: str
    kind: type
    description: str


Overrides = Mapping[str, Override]
Arguments = Mapping[str, tuple[object, str]]
"""Default and description by name."""


def _override(argument: str, parameter: str, what: str, kind: type = str) -> Overrides:
    return {argument: Override(parameter, kind, f"{what}; empty: value of the parameter file")}


RT_PRIORITY = _override("rt_priority", "realtime.priority", "SCHED_FIFO priority, 0 for none", int)
LAW = _override("law", "control.law", "Control law")
MAP = _override("map", "stage.guide.file", "Survey file")
HARDWARE = _override("hardware", "hardware", "Machine, 'simulated' or 'can'")
OUTPUT = _override("output", "output", "Folder of the bag")
OPCUA_USERS = _override("opcua_users", "opcua.users", "File of the gateway's users")
OF_ALL: Arguments = {
    "namespace": ("", "Namespace of all started nodes"),
    "params_file": (PathJoinSubstitution([SHARE, "config", "straightcomp.yaml"]), "YAML file of parameters"),
    "stage": (PathJoinSubstitution([SHARE, "config", "stage_synthetic.yaml"]), "YAML file that describes the stage"),
}
"""Arguments of each launch file."""
RECORD: Arguments = {"record": ("true", "false: start no logger and record no bag")}


def use_opcua(default: str) -> Arguments:
    """The argument that chooses between cell and gateway."""
    return {"use_opcua": (default, "true: start the OPC UA gateway instead of the cell; its client runs the cycles")}


def described(arguments: Arguments, overrides: Overrides, actions: Iterable[object]) -> LaunchDescription:
    """A launch description: the arguments, those of every launch file included, and the actions that start nodes."""
    texts = {**OF_ALL, **arguments, **{name: ("", override.description) for name, override in overrides.items()}}
    declared = [
        DeclareLaunchArgument(
            name, default_value=default, description=text, choices=_CHOICES if default in _CHOICES else None
        )
        for name, (default, text) in texts.items()
    ]
    # Keep 2 kHz topics off the network unless the user asks for more.
    on_this_computer = SetEnvironmentVariable(_DISCOVERY, EnvironmentVariable(_DISCOVERY, default_value="LOCALHOST"))
    return LaunchDescription([*declared, on_this_computer, *actions])


def starting(
    name: str, overrides: Overrides, *, only_if: Mapping[str, bool] | None = None, runs_cycle: bool = False
) -> OpaqueFunction:
    """Start the node ``name`` if the arguments in ``only_if`` have the given values.

    A node that ``runs_cycle`` waits for all others (except the logger with ``record:=false``); its end ends the launch.
    """

    def actions(context: LaunchContext) -> list[object]:
        if any(_is_true(context, argument) is not wanted for argument, wanted in (only_if or {}).items()):
            return []
        # The arguments' values are known only now. An empty one leaves the parameter to the file or the default.
        given = {argument: LaunchConfiguration(argument).perform(context) for argument in overrides}
        parameters = _surveys_of_stage(LaunchConfiguration("stage").perform(context), name) | {
            overrides[argument].parameter: ParameterValue(value, value_type=overrides[argument].kind)
            for argument, value in given.items()
            if value
        }
        if runs_cycle and not _is_true(context, "record"):
            parameters["nodes"] = ParameterValue("driver feedforward controller", value_type=str)
        node = Node(
            package=PACKAGE,
            executable=f"{name}_node",
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("params_file"),
                LaunchConfiguration("stage"),
                *([parameters] if parameters else []),
            ],
            output="screen",
        )
        if not runs_cycle:
            return [node]
        shutdown = EmitEvent(event=Shutdown(reason=f"the {name} has ended"))
        # Register the handler before the node starts: a wrong parameter ends the node at once.
        return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=[shutdown])), node]

    return OpaqueFunction(function=actions)


def _surveys_of_stage(stage: str, node: str) -> dict[str, ParameterValue]:
    """Parameters of ``node`` that name a survey in the folder of the stage file: a node alone would not look there."""
    try:
        found = files_beside(stage, read_parameter_file(stage))
    except ParameterError:
        # The node refuses the file, and says why.
        return {}
    described = {f"{STAGE}.{name}": survey for name, survey in found.get(STAGE, {}).items()}
    return {name: ParameterValue(survey, value_type=str) for name, survey in (described | found.get(node, {})).items()}


def _is_true(context: LaunchContext, argument: str) -> bool:
    return LaunchConfiguration(argument).perform(context) == "true"
