"""Executes the launch files with a stand-in for `launch` and `launch_ros`, which PyPI has not.

The stand-in knows exactly the names that the launch files may use, as they are in Jazzy: a misspelt import
fails here. What launch does with the actions is not tested.
"""

import runpy
import sys
import tempfile
import types
from pathlib import Path

import pytest
from places import REPOSITORY
from rcl_sections import taken

from straightcomp_ros.parameters.declaration import ParameterError, declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS
from straightcomp_ros.parameters.parameter_file import DEFAULT_FILE, DEFAULT_STAGE, read_parameter_file
from straightcomp_ros.parameters.yaml_text import node_sections

LAUNCH_FILES = sorted((REPOSITORY / "launch").glob("*.launch.py"))
CELL = REPOSITORY / "launch" / "cell.launch.py"
SHIPPED, SHIPPED_STAGE = (str(REPOSITORY / name) for name in (DEFAULT_FILE, DEFAULT_STAGE))
SHIPPED_TOO = str(REPOSITORY / "docs" / ".." / DEFAULT_FILE)
KNOWN = {
    "launch": "LaunchContext LaunchDescription",
    "launch.actions": "DeclareLaunchArgument EmitEvent IncludeLaunchDescription OpaqueFunction RegisterEventHandler "
    "SetEnvironmentVariable",
    "launch.conditions": "IfCondition UnlessCondition",
    "launch.event_handlers": "OnProcessExit",
    "launch.events": "Shutdown",
    "launch.launch_description_sources": "PythonLaunchDescriptionSource",
    "launch.substitutions": "EnvironmentVariable LaunchConfiguration PathJoinSubstitution",
    "launch_ros": "",
    "launch_ros.actions": "Node",
    "launch_ros.substitutions": "FindPackageShare",
}
STARTING = ("Node", "IncludeLaunchDescription", "OpaqueFunction")
NODE_KEYWORDS = {"package", "executable", "name", "namespace", "parameters", "output"}


class Recorded:
    """Remembers what it was made of; stands for every class of launch."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs

    def perform(self, context):
        """What LaunchConfiguration does: the value of the launch argument that it names; or PathJoinSubstitution."""
        [name] = self.args
        return context[name] if isinstance(name, str) else str(REPOSITORY.joinpath(*name[1:]))


@pytest.fixture(autouse=True)
def launch(monkeypatch, tmp_path):
    # A file of parameters is removed when its node ends; here none starts.
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for name, attributes in KNOWN.items():
        module = types.ModuleType(name)
        for attribute in attributes.split():
            setattr(module, attribute, type(attribute, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    yield
    # What the launch files share was imported with the stand-in.
    sys.modules.pop("straightcomp_ros.runtime.launch_files", None)


def kind(entity):
    return type(entity).__name__


def entities(path, arguments=None):
    """All that a launch file starts, with what it includes and what its functions return."""
    [described] = runpy.run_path(str(path))["generate_launch_description"]().args
    arguments_of = [entity for entity in described if kind(entity) == "DeclareLaunchArgument"]
    defaults = {entity.args[0]: entity.kwargs["default_value"] for entity in arguments_of}
    context = {name: value if isinstance(value, str) else value.perform({}) for name, value in defaults.items()}
    context |= arguments or {}
    found = []
    for entity in described:
        found.append(entity)
        if kind(entity) == "OpaqueFunction":
            found += entity.kwargs["function"](context)
        elif kind(entity) == "IncludeLaunchDescription":
            [source], condition = entity.args, entity.kwargs["condition"]
            assert set(dict(entity.kwargs["launch_arguments"])) == set(defaults) - {"composed"}
            if condition and (kind(condition) == "IfCondition") != (condition.args[0].perform(context) == "true"):
                continue
            found += entities(REPOSITORY.joinpath(*source.args[0].args[0][1:]), context)
    return found


def of_kind(wanted, path, **arguments):
    return [entity for entity in entities(path, arguments) if kind(entity) == wanted]


def declared(path):
    return {argument.args[0] for argument in of_kind("DeclareLaunchArgument", path)}


def configurations(value):
    """Names of the launch arguments that something made for launch refers to."""
    if isinstance(value, Recorded):
        return {value.args[0]} if kind(value) == "LaunchConfiguration" else configurations([value.args, value.kwargs])
    if isinstance(value, dict):
        value = list(value.values())
    return set().union(*map(configurations, value)) if isinstance(value, list | tuple) else set()


def given(node):
    """Parameters of a node beyond the files of the user."""
    last = node.kwargs["parameters"][-1]
    return {} if isinstance(last, Recorded) else dict(next(iter(node_sections(Path(last))))[1])


def named(nodes):
    return [node.kwargs["executable"].removesuffix("_node") for node in nodes]


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_every_launch_file_uses_declared_arguments_and_starts_installed_nodes_on_this_computer(path, setup_arguments):
    found, nodes = entities(path), of_kind("Node", path)
    assert nodes and configurations(found) <= declared(path) >= {"namespace", "params_file"}
    installed = {line.partition(" = ")[0] for line in setup_arguments["entry_points"]["console_scripts"]}
    for node in nodes:
        assert set(node.kwargs) <= NODE_KEYWORDS and node.kwargs["package"] == "straightcomp_ros"
        assert node.kwargs["executable"] in installed
        # Three nodes run in the servo's process: it has no name that would be theirs.
        assert node.kwargs.get("name", "servo") == node.kwargs["executable"].removesuffix("_node")
    for argument in of_kind("DeclareLaunchArgument", path):
        either = argument.args[0] in ("record", "use_opcua", "composed")
        assert argument.kwargs["choices"] == (["true", "false"] if either else None), argument.args

    # What is launched stays on this computer unless the environment says otherwise.
    [setting] = of_kind("SetEnvironmentVariable", path)[:1]
    kinds = [kind(entity) for entity in found]
    assert kinds.index("SetEnvironmentVariable") < min(place for place, one in enumerate(kinds) if one in STARTING)
    name, value = setting.args
    assert name == "ROS_AUTOMATIC_DISCOVERY_RANGE"
    assert (kind(value), value.args, value.kwargs) == ("EnvironmentVariable", (name,), {"default_value": "LOCALHOST"})


def test_the_cell_takes_all_that_its_nodes_take():
    nodes = set().union(*(declared(path) for path in LAUNCH_FILES if path != CELL))
    common = {"namespace", "record", "rt_priority", "params_file", "stage", "output"}
    assert declared(CELL) - {"composed"} == nodes == common | {"law", "map", "hardware", "use_opcua", "opcua_users"}


@pytest.mark.parametrize("record", ["true", "false"])
@pytest.mark.parametrize("opcua", ["true", "false"])
def test_the_cell_starts_each_node_once_and_its_last_waits_for_those_that_are_there(opcua, record):
    others = ["driver", "feedforward", "controller", *(["logger"] if record == "true" else [])]
    found = entities(CELL, {"use_opcua": opcua, "record": record, "rt_priority": "20"})
    *_, last = nodes = [entity for entity in found if kind(entity) == "Node"]
    assert named(nodes) == [*others, "opcua" if opcua == "true" else "cell"]
    assert all(configurations(node.kwargs["namespace"]) == {"namespace"} for node in nodes)
    file, stage, _ = last.kwargs["parameters"]
    assert configurations(file) == {"params_file"} and stage.perform({}) == SHIPPED_STAGE
    assert given(last).get("nodes") == (None if record == "true" else " ".join(others))
    assert [given(node)["realtime.priority"] for node in nodes] == [20] * len(nodes)
    # The whole launch ends when the last has ended; who watches for that is there before it starts.
    *_, handler = [entity for entity in found if kind(entity) == "RegisterEventHandler"]
    [on_exit] = handler.args
    assert kind(on_exit) == "OnProcessExit" and on_exit.kwargs["target_action"] is last
    assert kind(on_exit.kwargs["on_exit"][-1].kwargs["event"]) == "Shutdown"
    assert found.index(handler) < found.index(last)


OVERRIDES = """controller law control.law
logger output output
driver hardware hardware
feedforward map stage.guide.file
opcua opcua_users opcua.users"""


@pytest.mark.parametrize("case", OVERRIDES.splitlines())
def test_an_argument_overrides_its_parameter_only_when_it_is_given(case):
    node, argument, parameter = case.split()

    def overrides(**arguments):
        nodes = of_kind("Node", CELL, use_opcua="true" if node == "opcua" else "false", **arguments)
        return given(nodes[named(nodes).index(node)])

    assert overrides() == {}
    assert overrides(**{argument: "2024"}) == {parameter: "2024"}
    assert parameter in {declaration.name for declaration in declarations(NODE_PARAMETERS[node])}


@pytest.fixture
def stage(tmp_path):
    """A stage file with its survey beside it."""
    (tmp_path / "guide.csv").touch()
    (tmp_path / "stage.yaml").write_text("/**: {ros__parameters: {stage: {guide: {file: guide.csv}}}}")
    return tmp_path / "stage.yaml"


@pytest.mark.parametrize("composed", ["true", "false"])
@pytest.mark.parametrize("argument", ["stage", "params_file"])
def test_a_file_for_another_namespace_only_starts_no_node(stage, argument, composed):
    stage.write_text(stage.read_text().replace("/**", "left/**"))
    with pytest.raises(ParameterError, match=rf"{stage}: .*no namespace.*left/\*\*"):
        entities(CELL, {argument: str(stage), "composed": composed})


GUIDE, OWN, OTHER = (f"{{ros__parameters: {{stage.guide.file: {name}.csv}}}}" for name in ("guide", "own", "other"))
SHIPPED_SURVEY = read_parameter_file(SHIPPED_STAGE)["stage"]["guide.file"]
RATE, NOTHING = "{ros__parameters: {stage.rate: 500}}", "{ros__parameters: {}}"
LINEAR = "{ros__parameters: {control.law: linear}}"


@pytest.mark.parametrize(("namespace", "composed"), [("", "false"), ("/left", "true")])
@pytest.mark.parametrize(
    ("params_file", "described", "survey"),
    [
        # The shipped stage is behind the shipped parameters alone.
        (None, None, "shipped"),
        (SHIPPED_TOO, None, "shipped"),
        (SHIPPED, f"NS/**: {GUIDE}", "guide"),
        (f"NS/**: {GUIDE}", None, "guide"),
        # A node's own survey takes precedence, also where it is in the working directory.
        (SHIPPED, f"NS/**: {GUIDE}, NS/feedforward: {OWN}", "own"),
        (SHIPPED, f"NS/**: {GUIDE}, NS/feedforward: {OTHER}", "other"),
        # The shipped file has that section, before the `/**` of the stage file.
        (SHIPPED, f"/**: {GUIDE}, /**/feedforward: {OWN}", "guide"),
        # One of the parameter file is not looked for beside the stage file.
        (f"/**: {RATE}, NS/feedforward: {OWN}", f"/**: {GUIDE}, NS/driver: {GUIDE}", "own, by its name"),
        (f"NS/feedforward: {OTHER}, /**: {RATE}", f"/**: {GUIDE}, NS/driver: {GUIDE}", "guide"),
        (f"NS/controller: {NOTHING}, NS/feedforward: {NOTHING}, /**: {LINEAR}", f"NS/**: {GUIDE}", "guide"),
    ],
)
def test_each_node_takes_the_survey_that_counts_from_the_folder_of_its_description_and_overrides_after_all_sections(
    tmp_path, monkeypatch, params_file, described, survey, namespace, composed
):
    work, arguments = tmp_path / "work", {"namespace": namespace.lstrip("/"), "composed": composed}
    work.mkdir()
    monkeypatch.chdir(work)
    places = {"guide": tmp_path / "guide.csv", "own": tmp_path / "own.csv", "other": work / "other.csv"}
    for place in places.values():
        place.touch()
    for argument, text in (("params_file", params_file), ("stage", described)):
        if text in (None, SHIPPED, SHIPPED_TOO):
            arguments |= {argument: text} if text else {}
            continue
        arguments[argument] = str(tmp_path / f"{argument}.yaml")
        Path(arguments[argument]).write_text(f"{{{text.replace('NS', namespace)}}}")

    def takes(**overrides):
        """Survey and law of each node."""
        nodes = of_kind("Node", CELL, **arguments, **overrides)
        context = {"params_file": SHIPPED, **arguments}
        for node in ("driver", "feedforward", "controller", "logger", "cell"):
            # In one process the loop is the first.
            given = nodes[named(nodes).index(node) if node in named(nodes) else 0].kwargs["parameters"]
            files = [one.perform(context) if isinstance(one, Recorded) else one for one in given]
            assert (SHIPPED_STAGE in files) is (survey == "shipped")
            values = taken(f"{namespace}/{node}", files)
            yield values["stage.guide.file"], values.get("control.law")

    # A node finds what is in the working directory by itself.
    survey_of = {"guide": str(places["guide"]), "own": str(places["own"]), "other": "other.csv"}
    survey_of["own, by its name"] = "own.csv"
    survey_of["shipped"] = SHIPPED_SURVEY
    of_all = survey_of["shipped" if survey == "shipped" else "guide"]
    assert [name for name, _ in takes()] == [of_all, survey_of[survey], *[of_all] * 3]
    overridden = [*takes(map="third.csv", law="smc")]
    assert [name for name, _ in overridden] == [of_all, "third.csv", *[of_all] * 3] and overridden[2][1] == "smc"


def test_a_composed_cell_starts_one_process_with_the_parameters_of_each_of_its_nodes(stage):
    given = {"composed": "true", "hardware": "can", "law": "smc", "rt_priority": "30", "stage": str(stage)}
    started = entities(CELL, given)
    found = [entity for entity in started if kind(entity) == "Node"]
    assert named(found) == ["servo", "logger", "cell"]
    file = found[0].kwargs["parameters"][-1]
    given = {node: values for node, values in read_parameter_file(file).items() if values}
    at_exit = [entity.args[0].kwargs for entity in started if kind(entity) == "RegisterEventHandler"]
    [remove] = next(one["on_exit"] for one in at_exit if one["target_action"] is found[0])
    remove.kwargs["function"](None)
    assert not Path(file).exists()
    survey = {"stage.guide.file": str(stage.with_name("guide.csv")), "realtime.priority": 30}
    assert given == {
        "driver": {**survey, "hardware": "can"},
        "feedforward": survey,
        "controller": {**survey, "control.law": "smc"},
    }
