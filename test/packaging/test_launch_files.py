"""Executes the launch files with a stand-in for `launch` and `launch_ros`, which PyPI has not.

The stand-in knows exactly the names that the launch files may use, as they are in Jazzy: a misspelt import
fails here. What launch does with the actions is not tested.
"""

import re
import runpy
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS

REPOSITORY = Path(__file__).resolve().parents[2]
LAUNCH_FILES = sorted((REPOSITORY / "launch").glob("*.launch.py"))
NODES = ("driver", "feedforward", "controller", "logger", "cell")
KNOWN = {
    "launch": ("LaunchContext", "LaunchDescription"),
    "launch.actions": (
        "DeclareLaunchArgument",
        "EmitEvent",
        "IncludeLaunchDescription",
        "OpaqueFunction",
        "RegisterEventHandler",
        "SetEnvironmentVariable",
    ),
    "launch.event_handlers": ("OnProcessExit",),
    "launch.events": ("Shutdown",),
    "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
    "launch.substitutions": ("EnvironmentVariable", "LaunchConfiguration", "PathJoinSubstitution"),
    "launch_ros": (),
    "launch_ros.actions": ("Node",),
    "launch_ros.parameter_descriptions": ("ParameterValue",),
    "launch_ros.substitutions": ("FindPackageShare",),
}
STARTING = ("Node", "IncludeLaunchDescription", "OpaqueFunction")
NODE_KEYWORDS = {"package", "executable", "name", "namespace", "parameters", "output"}


class Recorded:
    """Remembers what it was made of; stands for every class of launch."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs

    def perform(self, context: dict[str, str]) -> str:
        """What LaunchConfiguration does: the value of the launch argument that it names."""
        return context[self.args[0]]


@pytest.fixture(autouse=True)
def launch(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name, attributes in KNOWN.items():
        module = types.ModuleType(name)
        for attribute in attributes:
            setattr(module, attribute, type(attribute, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    yield
    # What the launch files share was imported with the stand-in.
    sys.modules.pop("straightcomp_ros.runtime.launch_files", None)


def kind(entity: Any) -> str:
    return type(entity).__name__


def is_argument(entity: Any) -> bool:
    return kind(entity) == "DeclareLaunchArgument"


def entities(path: Path, arguments: dict[str, str] | None = None) -> list[Any]:
    """All that a launch file starts, with what it includes and what its functions return."""
    [described] = runpy.run_path(str(path))["generate_launch_description"]().args
    defaults = {entity.args[0]: entity.kwargs["default_value"] for entity in described if is_argument(entity)}
    # A place in the package is found by launch alone.
    context = {name: value if isinstance(value, str) else "" for name, value in defaults.items()}
    context.update(arguments or {})
    found: list[Any] = []
    for entity in described:
        found.append(entity)
        if kind(entity) == "OpaqueFunction":
            found += entity.kwargs["function"](context)
        elif kind(entity) == "IncludeLaunchDescription":
            [source] = entity.args
            assert set(dict(entity.kwargs["launch_arguments"])) == set(defaults)
            found += entities(REPOSITORY.joinpath(*source.args[0].args[0][1:]), context)
    return found


def of_kind(wanted: str, path: Path, **arguments: str) -> list[Any]:
    return [entity for entity in entities(path, arguments) if kind(entity) == wanted]


def declared(path: Path) -> set[str]:
    return {argument.args[0] for argument in of_kind("DeclareLaunchArgument", path)}


def configurations(value: Any) -> set[str]:
    """Names of the launch arguments that something made for launch refers to."""
    if isinstance(value, Recorded):
        return {value.args[0]} if kind(value) == "LaunchConfiguration" else configurations([value.args, value.kwargs])
    if isinstance(value, dict):
        value = list(value.values())
    return set().union(*map(configurations, value)) if isinstance(value, list | tuple) else set()


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_every_launch_argument_that_is_used_is_declared(path: Path) -> None:
    assert configurations(entities(path)) <= declared(path)


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_every_launch_file_starts_nodes_that_setup_py_installs(path: Path) -> None:
    scripts = set(re.findall(r"\w+", re.search(r"for node in \((.*?)\)", (REPOSITORY / "setup.py").read_text())[1]))
    nodes = of_kind("Node", path)
    assert nodes
    for node in nodes:
        assert set(node.kwargs) <= NODE_KEYWORDS
        assert node.kwargs["package"] == "straightcomp_ros"
        assert node.kwargs["executable"] == f"{node.kwargs['name']}_node"
        assert node.kwargs["name"] in scripts


def test_the_cell_starts_each_node_once_in_the_same_namespace() -> None:
    nodes = of_kind("Node", REPOSITORY / "launch" / "cell.launch.py")
    assert tuple(node.kwargs["name"] for node in nodes) == NODES
    assert [configurations(node.kwargs["namespace"]) for node in nodes] == [{"namespace"}] * len(NODES)


def test_the_cell_takes_all_that_its_nodes_take() -> None:
    nodes = set().union(*(declared(path) for path in LAUNCH_FILES if path.name != "cell.launch.py"))
    assert declared(REPOSITORY / "launch" / "cell.launch.py") == nodes
    common = {"namespace", "record", "rt_priority", "params_file", "stage", "output"}
    assert nodes == common | {"law", "map", "hardware", "use_opcua", "opcua_users"}


def test_without_a_recording_there_is_no_logger_and_the_cell_does_not_wait_for_one() -> None:
    nodes = of_kind("Node", REPOSITORY / "launch" / "cell.launch.py", record="false")
    assert [node.kwargs["name"] for node in nodes] == ["driver", "feedforward", "controller", "cell"]
    [_, _, chosen] = nodes[-1].kwargs["parameters"]
    assert chosen["nodes"].args == ("driver feedforward controller",)


@pytest.mark.parametrize("record, logger", [("true", ["logger"]), ("false", [])])
def test_with_opcua_the_gateway_stands_in_the_place_of_the_cell(record: str, logger: list[str]) -> None:
    nodes = of_kind("Node", REPOSITORY / "launch" / "cell.launch.py", use_opcua="true", record=record)
    others = ["driver", "feedforward", "controller", *logger]
    assert [node.kwargs["name"] for node in nodes] == [*others, "opcua"]
    gateway = nodes[-1].kwargs
    assert configurations(gateway["namespace"]) == {"namespace"}
    file, stage, *chosen = gateway["parameters"]
    assert configurations(file) == {"params_file"} and configurations(stage) == {"stage"}
    assert [(list(given), given["nodes"].args) for given in chosen] == (
        [] if logger else [(["nodes"], (" ".join(others),))]
    )


def test_with_opcua_the_whole_launch_ends_when_the_gateway_has_ended() -> None:
    found = entities(REPOSITORY / "launch" / "cell.launch.py", {"use_opcua": "true"})
    [handler] = [entity for entity in found if kind(entity) == "RegisterEventHandler"]
    [on_exit] = handler.args
    assert on_exit.kwargs["target_action"].kwargs["name"] == "opcua"
    assert found.index(handler) < found.index(on_exit.kwargs["target_action"])


def test_the_gateway_takes_its_users_from_the_launch() -> None:
    path = REPOSITORY / "launch" / "cell.launch.py"
    [_, _, chosen] = of_kind("Node", path, use_opcua="true", opcua_users="/tmp/users")[-1].kwargs["parameters"]
    assert (chosen["opcua.users"].args, chosen["opcua.users"].kwargs) == (("/tmp/users",), {"value_type": str})
    known = yaml.safe_load((REPOSITORY / "config" / "straightcomp.yaml").read_text(encoding="utf-8"))
    assert "opcua.users" in known["/**/opcua"]["ros__parameters"]


def test_one_priority_is_given_to_all_nodes() -> None:
    nodes = of_kind("Node", REPOSITORY / "launch" / "cell.launch.py", rt_priority="20")
    given = [node.kwargs["parameters"][-1]["realtime.priority"] for node in nodes]
    assert [(value.args, value.kwargs) for value in given] == [(("20",), {"value_type": int})] * len(NODES)


def test_the_gateway_has_the_same_priority() -> None:
    nodes = of_kind("Node", REPOSITORY / "launch" / "cell.launch.py", rt_priority="20", use_opcua="true")
    assert [node.kwargs["parameters"][-1]["realtime.priority"].args for node in nodes] == [("20",)] * len(NODES)


def test_the_whole_launch_ends_when_the_cell_has_ended() -> None:
    found = entities(REPOSITORY / "launch" / "cell.launch.py")
    [handler] = [entity for entity in found if kind(entity) == "RegisterEventHandler"]
    [cell] = [entity for entity in found if kind(entity) == "Node" and entity.kwargs["name"] == "cell"]
    [on_exit] = handler.args
    assert kind(on_exit) == "OnProcessExit"
    assert on_exit.kwargs["target_action"] is cell
    assert [kind(action.kwargs["event"]) for action in on_exit.kwargs["on_exit"]] == ["Shutdown"]
    assert found.index(handler) < found.index(cell)


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_what_is_launched_stays_on_this_computer_unless_the_environment_says_otherwise(path: Path) -> None:
    found = entities(path)
    setting = next(entity for entity in found if kind(entity) == "SetEnvironmentVariable")
    assert found.index(setting) < min(found.index(entity) for entity in found if kind(entity) in STARTING)
    name, value = setting.args
    assert name == "ROS_AUTOMATIC_DISCOVERY_RANGE"
    assert (kind(value), value.args, value.kwargs) == ("EnvironmentVariable", (name,), {"default_value": "LOCALHOST"})


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_an_argument_that_is_true_or_false_takes_nothing_else(path: Path) -> None:
    for argument in of_kind("DeclareLaunchArgument", path):
        either = argument.args[0] in ("record", "use_opcua")
        assert argument.kwargs["choices"] == (["true", "false"] if either else None), argument.args


@pytest.mark.parametrize(
    "node, argument, parameter",
    [
        ("controller", "law", "control.law"),
        ("logger", "output", "output"),
        ("driver", "hardware", "hardware"),
        ("feedforward", "map", "stage.guide.file"),
    ],
)
def test_an_argument_overrides_its_parameter_only_when_it_is_given(node: str, argument: str, parameter: str) -> None:
    path = REPOSITORY / "launch" / "cell.launch.py"

    def overrides(**arguments: str) -> list[Any]:
        [found] = [entity for entity in of_kind("Node", path, **arguments) if entity.kwargs["name"] == node]
        return found.kwargs["parameters"][2:]

    assert overrides() == []
    [given] = overrides(**{argument: "2024"})
    assert list(given) == [parameter]
    assert (given[parameter].args, given[parameter].kwargs) == (("2024",), {"value_type": str})
    assert parameter in {declaration.name for declaration in declarations(NODE_PARAMETERS[node])}


def test_a_survey_beside_the_stage_file_is_found_wherever_the_launch_is_started(tmp_path: Path) -> None:
    stage = tmp_path / "stage.yaml"
    (tmp_path / "guide.csv").touch()
    stage.write_text("/**: {ros__parameters: {stage: {guide: {file: guide.csv}}}}")
    path = REPOSITORY / "launch" / "cell.launch.py"
    for node in of_kind("Node", path, stage=str(stage)):
        [_, _, given] = node.kwargs["parameters"]
        assert given["stage.guide.file"].args == (str(tmp_path / "guide.csv"),)


def test_every_launch_file_may_be_given_other_parameters() -> None:
    assert {path.name: declared(path) >= {"namespace", "params_file"} for path in LAUNCH_FILES} == {
        path.name: True for path in LAUNCH_FILES
    }
