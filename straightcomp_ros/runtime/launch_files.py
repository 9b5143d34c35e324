"""What the files in launch/ share: a node's arguments, and the parameters that they override. Only they import it."""

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

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
from launch_ros.substitutions import FindPackageShare

from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import STAGE
from straightcomp_ros.parameters.parameter_file import (
    ALL_NODES,
    DEFAULT_FILE,
    DEFAULT_STAGE,
    OtherNamespaceError,
    files_beside,
    read_parameter_file,
)
from straightcomp_ros.parameters.share import PACKAGE
from straightcomp_ros.parameters.yaml_text import PARAMETERS, dump_yaml

SHARE = FindPackageShare(PACKAGE)
_SHIPPED_FILE, _SHIPPED_STAGE = (
    PathJoinSubstitution([SHARE, *Path(name).parts]) for name in (DEFAULT_FILE, DEFAULT_STAGE)
)
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
    "params_file": (_SHIPPED_FILE, "YAML file of parameters"),
    "stage": ("", "YAML file that describes the stage; empty: as params_file describes it, in ours the shipped stage"),
}
"""Default and meaning of the arguments of each launch file."""
IN_THE_LOOP = {
    "driver": ("hardware", "rt_priority"),
    "feedforward": ("map", "rt_priority"),
    "controller": ("law", "rt_priority"),
}
"""Arguments of the nodes that can run in one process."""
_CHOICES = {
    "record": "false: start no logger and record no bag",
    "composed": "true: run driver, feedforward and controller in one process",
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
        given = _given(context, name, overrides)
        if runs_cycle and not _is_true(context, "record"):
            given["nodes"] = "driver feedforward controller"
        at_end = [EmitEvent(event=Shutdown(reason=f"the {name} has ended"))] if runs_cycle else []
        return _started(context, f"{name}_node", {name: given}, at_end, name=name)

    return described(choices, overrides, [OpaqueFunction(function=actions)])


def launched_composed() -> LaunchDescription:
    """Start the nodes of :data:`IN_THE_LOOP` in one process."""

    def actions(context: LaunchContext) -> list[object]:
        given = {name: _given(context, name, overrides) for name, overrides in IN_THE_LOOP.items()}
        return _started(context, "servo_node", given, [])

    return described({}, dict.fromkeys(sum(IN_THE_LOOP.values(), ())), [OpaqueFunction(function=actions)])


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


def _started(
    context: LaunchContext,
    executable: str,
    given: Mapping[str, Mapping[str, object]],
    at_end: list[object],
    **name: str,
) -> list[RegisterEventHandler | Node]:
    """Start a process with the parameters ``given`` of each of its nodes beyond the files; ``at_end`` is done when it
    has ended."""
    # rcl takes the last section, but lets those of one key be one at the place of the first: no other file has these
    # keys, of which each is of one node of the process.
    sections = {f"{ALL_NODES}/**/{node}": {PARAMETERS: values} for node, values in given.items() if values}
    parameters = []
    if sections:
        with tempfile.NamedTemporaryFile("w", prefix="straightcomp_", suffix=".yaml", delete=False) as file:
            file.write(dump_yaml(sections))
        parameters = [file.name]
        at_end = [OpaqueFunction(function=lambda _: Path(file.name).unlink(missing_ok=True)), *at_end]
    node = Node(
        package=PACKAGE,
        executable=executable,
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), *_stage_files(context), *parameters],
        output="screen",
        **name,
    )
    # Register the handler before the node starts: a wrong parameter ends the node at once.
    return [*([RegisterEventHandler(OnProcessExit(target_action=node, on_exit=at_end))] if at_end else []), node]


def _stage_files(context: LaunchContext) -> list[LaunchConfiguration | PathJoinSubstitution]:
    """The file behind the parameter file that describes the stage; none where a parameter file of the user does."""
    file, stage = (LaunchConfiguration(name).perform(context) for name in ("params_file", "stage"))
    if stage:
        return [LaunchConfiguration("stage")]
    ours = os.path.realpath(file) == os.path.realpath(_SHIPPED_FILE.perform(context))
    return [_SHIPPED_STAGE] if ours else []


def _given(context: LaunchContext, node: str, overrides: Iterable[str]) -> dict[str, object]:
    """Parameters of ``node`` by the arguments, whose values are known only now: an empty one leaves the parameter to
    the file or the default. A file in the folder of that which describes the stage is named, as a node alone would not
    look there. Raises OtherNamespaceError."""
    file, stage, namespace = (
        LaunchConfiguration(name).perform(context) for name in ("params_file", "stage", "namespace")
    )
    given: dict[str, object] = {}
    read: dict[str, dict[str, dict[str, Any]]] = {}
    for path in filter(None, (file, stage)):
        try:
            read[path] = read_parameter_file(path, namespace=namespace)
        except OtherNamespaceError:
            raise  # The node would pass over such a file.
        except ParameterError:
            continue  # The node refuses it, and says why.
    if values := read.get(stage or file):
        # What the other file's sections leave of it: a node's section that joins one there loses against a later `/**`.
        taken = read_parameter_file(*read, namespace=namespace)
        found = files_beside(stage or file, values, taken)
        described = {f"{STAGE}.{name}": full for name, full in found.get(STAGE, {}).items()}
        # A file of the node's own takes precedence, wherever it is.
        given = {name: full for name, full in described.items() if name not in taken[node]} | found.get(node, {})
    for argument in overrides:
        if value := LaunchConfiguration(argument).perform(context):
            parameter, kind, _ = OVERRIDES[argument]
            given[parameter] = kind(value)
    return given


def _is_true(context: LaunchContext, argument: str) -> bool:
    return LaunchConfiguration(argument).perform(context) == "true"
