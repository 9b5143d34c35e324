"""What the files in launch/ share: a node's arguments, and the parameters that they override. Only they import it."""

from collections.abc import Iterable, Mapping

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
OVERRIDES: Mapping[str, tuple[str, type, str]] = {
    "law": ("control.law", str, "Control law"),
    "map": ("stage.guide.file", str, "Survey file"),
    "hardware": ("hardware", str, "Machine, 'simulated' or 'can'"),
    "rt_priority": ("realtime.priority", int, "SCHED_FIFO priority, 0 for none"),
    "opcua_users": ("opcua.users", str, "File of the gateway's users"),
    "output": ("output", str, "Folder of the bag"),
}
"""Arguments that set a parameter, with its type and meaning; one that is given takes precedence over the file."""
OF_ALL = {
    "namespace": ("", "Namespace of all started nodes"),
    "params_file": (PathJoinSubstitution([SHARE, "config", "straightcomp.yaml"]), "YAML file of parameters"),
    "stage": (PathJoinSubstitution([SHARE, "config", "stage_synthetic.yaml"]), "YAML file that describes the stage"),
}
"""Default and meaning of the arguments of each launch file."""
_CHOICES = {
    "record": "false: start no logger and record no bag",
    "use_opcua": "true: start the OPC UA gateway instead of the cell; its client runs the cycles",
}
"""Arguments that are true or false; other values, such as `True` or `1`, are refused."""


def launched(
    name: str, *overrides: str, only_if: Mapping[str, bool] | None = None, runs_cycle: bool = False, **choices: str
) -> LaunchDescription:
    """Start the node ``name`` if the arguments in ``only_if`` have the given values; see :func:`described`.

    A node that ``runs_cycle`` waits for all others (except the logger with ``record:=false``); its end ends the launch.
    """

    def actions(context: LaunchContext) -> list[object]:
        if any(_is_true(context, argument) is not wanted for argument, wanted in (only_if or {}).items()):
            return []
        parameters = _surveys_of_stage(LaunchConfiguration("stage").perform(context), name)
        for argument in overrides:
            # The arguments' values are known only now. An empty one leaves the parameter to the file or the default.
            if value := LaunchConfiguration(argument).perform(context):
                parameter, kind, _ = OVERRIDES[argument]
                parameters[parameter] = ParameterValue(value, value_type=kind)
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

    return described(choices, overrides, [OpaqueFunction(function=actions)])


def described(choices: Mapping[str, str], overrides: Iterable[str], actions: Iterable[object]) -> LaunchDescription:
    """A launch description: the arguments, those of every launch file included, and the actions that start nodes.
    ``choices`` are the defaults of those that are true or false."""
    arguments = {
        **{name: (default, text, None) for name, (default, text) in OF_ALL.items()},
        **{name: (default, _CHOICES[name], ["true", "false"]) for name, default in choices.items()},
        **{name: ("", f"{OVERRIDES[name][2]}; empty: value of the parameter file", None) for name in overrides},
    }
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=allowed)
        for name, (default, text, allowed) in arguments.items()
    ]
    # Keep 2 kHz topics off the network unless the user asks for more.
    on_this_computer = SetEnvironmentVariable(_DISCOVERY, EnvironmentVariable(_DISCOVERY, default_value="LOCALHOST"))
    return LaunchDescription([*declared, on_this_computer, *actions])


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
