import ast
import inspect
import os
import re
from argparse import Namespace
from dataclasses import dataclass, is_dataclass
from typing import get_type_hints

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import settings as of_examples
from hypothesis import strategies as st
from rcl_sections import taken

from scripts import make_parameter_file
from straightcomp_ros.cli.options import chosen_parameters, settings
from straightcomp_ros.parameters.declaration import (
    ParameterError,
    declarations,
    flatten,
    from_mapping,
    group,
    parameter,
    to_mapping,
)
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, node_parameters
from straightcomp_ros.parameters.parameter_file import (
    DEFAULT_FILE,
    DEFAULT_STAGE,
    as_parameter_file,
    read_parameter_file,
    shipped_parameters,
)
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.parameters.yaml_text import load_yaml
from straightcomp_ros.stage.description import StageParameters, UncertaintyParameters


@dataclass(frozen=True)
class Inner:
    gain: float = parameter(2.0, "Gain", "(0, 10] N/A")
    name: str = parameter("a", "Name", choices=("a", "b"))


@dataclass(frozen=True)
class Outer:
    count: int = parameter(3, "Count", "[1, inf)")
    on: bool = parameter(False, "On")
    inner: Inner = group(Inner, "Coil", gain=5.0)


def test_groups_are_addressed_with_a_dot_have_defaults_of_their_own_and_come_from_a_mapping_and_back():
    # `ros2 param describe` shows one parameter alone.
    assert [(one.name, one.default, one.description) for one in declarations(Outer)] == [
        *(("count", 3, "Count"), ("on", False, "On")),
        *(("inner.gain", 5.0, "Coil: Gain"), ("inner.name", "a", "Coil: Name")),
    ]
    assert from_mapping(Outer, {}) == Outer()
    assert from_mapping(Outer, {"inner.gain": 4}).inner.gain == 4.0
    values = {"count": 7, "on": True, "inner.gain": 1.5, "inner.name": "b"}
    assert to_mapping(from_mapping(Outer, values)) == values
    assert flatten({"inner": {"gain": 1.0}, "count": 2}) == {"inner.gain": 1.0, "count": 2}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cuont": 1}, "'cuont' is unknown; did you mean 'count'"),
        ({"count": 0}, r"'count': 0 is too small; allowed: >= 1"),
        ({"count": 1.5}, r"'count': 1\.5 is not an integer"),
        ({"count": True}, "'count': True is not an integer"),
        ({"on": 1}, "'on': 1 is not a truth value"),
        ({"inner.gain": 0.0}, r"'inner.gain': 0\.0 N/A is too small; allowed: > 0 and <= 10 N/A"),
        ({"inner.gain": 11}, r"'inner.gain': 11\.0 N/A is too large"),
        ({"inner.gain": float("nan")}, "not finite"),
        ({"inner.gain": "1e-3"}, "'1e-3' N/A is not a number"),
        ({"inner.name": "c"}, "'c' is not known; allowed: one of a, b"),
    ],
)
def test_a_refused_parameter_is_named_with_its_value_and_what_is_allowed(values, words):
    with pytest.raises(ParameterError, match=words):
        from_mapping(Outer, values)


@pytest.mark.parametrize("one", [1, np.float32(1.0), np.float64(1.0), np.int64(1)])
def test_numbers_of_numpy_are_numbers_and_are_written_as_such(one):
    found = from_mapping(Outer, {"inner.gain": one, "count": np.uint8(4)})
    assert (repr(found.inner.gain), repr(found.count)) == ("1.0", "4")
    assert yaml.safe_load(as_parameter_file({"driver": {"override": one}}))["/**/driver"]["ros__parameters"] == {
        "override": 1
    }


@pytest.mark.parametrize("node", NODE_PARAMETERS)
def test_every_default_is_allowed_and_every_parameter_is_described(node):
    declared = list(declarations(NODE_PARAMETERS[node]))
    assert all(one.check(one.default) == one.default for one in declared)
    assert all({one.description for one in declared}) and len({one.description for one in declared}) == len(declared)


def test_the_shipped_files_name_every_parameter_and_are_what_their_script_writes():
    texts = {DEFAULT_FILE: make_parameter_file.parameter_file(), DEFAULT_STAGE: make_parameter_file.stage_file()}
    assert {name: share_path(name).read_text() for name in texts} == texts
    values = read_parameter_file(share_path(DEFAULT_FILE))
    for node, parameter_set in NODE_PARAMETERS.items():
        node_parameters(node, values)
        own = [one.name for one in declarations(parameter_set) if not one.name.startswith("stage.")]
        assert list(values[node]) == own
    described = read_parameter_file(share_path(DEFAULT_STAGE))["stage"]
    assert list(described) == [declaration.name for declaration in declarations(StageParameters)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("drivr: {ros__parameters: {}}", "node 'drivr' is unknown"),
        ("driver: {}", "has no 'ros__parameters:'"),
        ("- 1", "NODE: ros__parameters:"),
        ("a: [", "no YAML"),
        ("/**: {ros__parameters: {stage.rate: 1, stage: {rate: 2}}}", "parameter 'stage.rate' is given twice"),
        ("/**: {driver: {ros__parameters: {}}, drivr: {}}", r"'/\*\*/drivr' has no 'ros__parameters:'"),
    ],
)
def test_a_bad_parameter_file_is_refused_with_its_name(tmp_path, text, words):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ParameterError, match=words) as refusal:
        read_parameter_file(path)
    assert str(path) in str(refusal.value)
    with pytest.raises(ParameterError, match=r"none\.yaml"):
        read_parameter_file(tmp_path / "none.yaml")


TOGETHER = """
driver | hardware=can lockstep=true | lockstep | hardware
driver | hardware=can stage.actuator.current_limit=50.0 | stage.actuator.current_limit |
driver | lockstep=true simulated.referenced=false | simulated.referenced | lockstep
driver | can.log=frames.txt | can.log |
driver | can.options=bitrate | can.options |
driver | can.options=channel=can1 | can.options | can.channel
driver | hardware=can can.wire.x.message=pos | can.wire.x.message | can.dbc
driver | stage.platform.stop=0.002 | stage.platform.stop | stage.actuator.air_gap
driver | stage.friction.static=0.1 | stage.friction.static | stage.friction.coulomb
driver | stage.friction.coulomb=0.0 | stage.friction.static | stage.friction.coulomb
driver | stage.platform.mass=1.0e-5 stage.actuator.bias_current=50.0 | stage.platform.mass | stage.rate \
stage.actuator.air_gap stage.actuator.turns stage.actuator.pole_area stage.actuator.bias_current
cell | stage.motion.jerk=1.0e-9 | stage.motion.jerk |
cell | stage.motion.speed=1.5 | stage.motion.highest_speed | stage.motion.speed
cell | stage.motion.stroke=0.0 | stage.motion.stroke |
feedforward | stage.guide.smooth=some | stage.guide.smooth |
controller | control.law=smc control.smc.rho=0.2 | control.smc.rho | control.smc.enforce_reaching
opcua | opcua.security=none opcua.host="0.0.0.0" | opcua.security | opcua.host
opcua | opcua.security=encrypted opcua.certificates=folder | opcua.users |
opcua | opcua.trusted=folder | opcua.trusted | opcua.security
uncertainty | longest_delay=0.1 shortest_delay=0.2 | longest_delay | shortest_delay
""".strip().splitlines()
"""Node, values of which one is refused because of others, the name that the message begins with, others in it."""
SETS = {**NODE_PARAMETERS, "uncertainty": UncertaintyParameters}


@pytest.mark.parametrize("case", TOGETHER, ids=lambda case: " ".join(case.split()[:4:2]))
def test_what_is_refused_together_with_other_parameters_is_named_as_it_is_set(case):
    node, given, name, others = (cell.strip() for cell in case.split("|"))
    with pytest.raises(ParameterError) as refused:
        from_mapping(SETS[node], {one: load_yaml(text) for one, text in (word.split("=", 1) for word in given.split())})
    message = str(refused.value)
    assert (message.startswith(f"parameter '{name}': ") and "allowed" in message) or "must" in message
    known = {declaration.name for declaration in declarations(SETS[node])}
    assert set(re.findall(r"'([\w.]+)'", message)) & known == {name, *others.split()}
    # Nor is one of them written without its group.
    assert not {full.rpartition(".")[2] for full in others.split()} & set(re.findall(r"'(\w+)'", message)) - known


@pytest.mark.parametrize("node", ["logger", "cell", "opcua"])
def test_what_can_be_no_name_of_a_node_is_refused_where_nodes_are_listed(node):
    for names in ("driver controller", "/left/driver", "driver_2", ""):
        assert from_mapping(NODE_PARAMETERS[node], {"nodes": names}).nodes == names
    for names in ("driver, controller", "driver/", "left//driver", "2nd", "Antrieb_ä"):
        with pytest.raises(ParameterError, match=r"parameter 'nodes': .*allowed: "):
            from_mapping(NODE_PARAMETERS[node], {"nodes": names})


def checking(parameter_set):
    """The set and its groups that judge parameters together with others."""
    found = {parameter_set} if {"__post_init__", "check"} & set(vars(parameter_set)) else set()
    return found.union(*(checking(kind) for kind in get_type_hints(parameter_set).values() if is_dataclass(kind)))


def test_each_refusal_together_with_other_parameters_is_among_those():
    judges = set().union(*map(checking, SETS.values()))
    trees = (ast.parse(inspect.getsource(judge)) for judge in judges)
    raised = [ast.unparse(one.exc.func) for tree in trees for one in ast.walk(tree) if isinstance(one, ast.Raise)]
    assert len(raised) == len(TOGETHER) and "ParameterError" not in raised


def test_a_written_parameter_file_is_read_as_it_was_with_the_facts_of_all_nodes_last(tmp_path):
    # rcl would take Y and n for truth values, were they not in quotes.
    values = {"stage": {"name": "Y", "rate": 4000, "platform.mass": 5.0}, "logger": {"output": "n"}, "controller": {}}
    values["driver"] = {"hardware": "can", "stage.platform.mass": 6.0}
    path = tmp_path / "p.yaml"
    path.write_text(as_parameter_file(values))
    # A parameter on a node's command line joins those of all nodes, and must win over the node's section.
    assert list(yaml.safe_load(path.read_text()))[-1] == "/**"
    assert "name: 'Y'" in path.read_text() and "output: 'n'" in path.read_text()
    read = read_parameter_file(path)
    for node in ("driver", "controller"):
        assert node_parameters(node, read) == node_parameters(node, values)
    assert read["logger"] == {"output": "n"} and read["stage"] == {"name": "Y", "rate": 4000}
    path.write_text(yaml.safe_dump({"/stage_1/driver": {"ros__parameters": {"simulated": {"initial_y": 1e-6}}}}))
    assert read_parameter_file(path, namespace="stage_1")["driver"] == {"simulated.initial_y": 1e-6}


MASS = "stage.platform.mass"
KEYS = ["/**", "/*", "driver", "/**/driver", "/*/driver", "/*/**/**"]
KEYS += ["/**:driver", "/stage_2:*", "stage_2/:driver", "/stage_2/**/driver"]
"""A colon stands between nested keys."""
SECTIONS = st.lists(st.sampled_from(KEYS), min_size=1, max_size=4, unique_by=lambda key: key.partition(":")[0])


@of_examples(max_examples=40)
@given(of_nodes=SECTIONS, of_stage=SECTIONS, namespace=st.sampled_from(["", "/stage_2/"]))
@example(["/**/driver", "/**"], ["/**", "driver"], "")
@example(["/**", "/**/driver"], ["/**"], "")
@example(["/**/driver"], ["/**", "/**/driver"], "")
@example(["/**/driver"], ["/**:driver"], "")
@example(["/stage_1/driver", "/stage_2/driver"], ["/stage_2/driver"], "/stage_2/")
@example(["/stage_1/driver"], ["/stage_2/driver"], "/stage_2/")
@example(["/stage_2/driver"], ["driver"], "")
def test_of_all_sections_of_two_files_a_node_takes_those_that_rcl_gives_it(
    tmp_path_factory, of_nodes, of_stage, namespace
):
    files, key_of = [tmp_path_factory.getbasetemp() / name for name in ("p.yaml", "stage.yaml")], {}
    for file, keys in zip(files, (of_nodes, of_stage), strict=True):
        tree = {}
        for key in keys:
            key_of[mass := len(key_of) + 1.0] = key
            section = {"ros__parameters": {MASS: mass}}
            for level in reversed(key.split(":")):
                section = {level: section}
            tree |= section
        file.write_text(yaml.safe_dump(tree, sort_keys=False))
    found = [taken(f"{namespace.rstrip('/')}/driver", of).get(MASS) for of in (files[:1], files[1:], files)]
    for file, mass in zip(files, found[:2], strict=True):
        if mass:
            read = read_parameter_file(file, namespace=namespace)
            assert node_parameters("driver", read).stage.platform.mass == mass
        else:
            with pytest.raises(ParameterError, match=rf"{file}: is for other nodes .*; allowed: /\*\*/NODE"):
                read_parameter_file(file, namespace=namespace)
    if not all(found[:2]):
        return
    given = Namespace(params_file=str(files[0]), stage=str(files[1]), law=None, set=[], namespace=namespace)
    _, alone, together = (key_of[mass].endswith("driver") for mass in found)
    if alone and not together:
        # A node would take what the stage file says of all.
        with pytest.raises(ParameterError, match=rf"{files[1]}: '{MASS}' of one node"):
            chosen_parameters(given)
    else:
        assert node_parameters("driver", chosen_parameters(given)).stage.platform.mass == found[2]


@pytest.mark.parametrize(
    ("assignment", "node", "value"),
    [
        ("stage.guide.smooth=1", "stage", {"guide.smooth": "1"}),
        ('stage.serial="0123"', "stage", {"serial": "0123"}),
        ("driver.can.wire.command.signal=N", "driver", {"can.wire.command.signal": "N"}),
        ("driver.can.wire.protection.sample.data_id=0x123", "driver", {"can.wire.protection.sample.data_id": "0x123"}),
        ("stage.guide.file= true", "stage", {"guide.file": "true"}),
        # As where a variable of a shell is not set.
        ("stage.guide.file=", "stage", {"guide.file": None}),
        ("stage.guide.file=[a, b]", "stage", {"guide.file": ["a", "b"]}),
        ("feedforward.stage.rate=0x3e8", "feedforward", {"stage.rate": 1000}),
    ],
)
def test_a_number_that_is_set_is_a_text_where_the_parameter_is_one(assignment, node, value):
    assert settings([assignment]) == {node: value}


def test_both_files_may_be_pipes_of_a_shell():
    ends = []
    for text in ("driver: {ros__parameters: {can.node: 3}}", "/**: {ros__parameters: {stage.rate: 1000}}"):
        end, written = os.pipe()
        ends.append(end)
        with open(written, "w") as pipe:
            pipe.write(text)
    read = shipped_parameters(*(f"/dev/fd/{end}" for end in ends))
    for end in ends:
        os.close(end)
    assert read["stage"] == {"rate": 1000} and read["driver"] == {"can.node": 3}


def test_parameters_of_ros_itself_are_no_nodes_own_and_a_home_folder_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "x.dbc").touch()
    path = tmp_path / "stage.yaml"
    path.write_text(
        "/**: {ros__parameters: {use_sim_time: true, stage.rate: 1000}}\n"
        "driver: {ros__parameters: {use_sim_time: true, qos_overrides: {/x: {depth: 1}}, can.dbc: ~/x.dbc}}\n"
    )
    read = shipped_parameters(path, path)
    assert read["stage"] == {"rate": 1000} and read["driver"] == {"can.dbc": str(tmp_path / "home" / "x.dbc")}


@pytest.mark.parametrize(
    ("node", "name"),
    [
        ("stage", "motion.file"),
        ("driver", "simulated.truth.disturbances.force_file"),
        ("feedforward", "stage.guide.file"),
    ],
)
def test_a_file_that_a_stage_file_names_is_that_in_its_folder_before_one_in_the_working_directory(
    tmp_path, monkeypatch, node, name
):
    path, key = tmp_path / "stage.yaml", "/**" if node == "stage" else node
    path.write_text(f"{key}: {{ros__parameters: {{{'stage.' if node == 'stage' else ''}{name}: named.csv}}}}")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    for file in (tmp_path / "named.csv", tmp_path / "work" / "named.csv"):
        file.write_text("0.2\n")
    assert shipped_parameters(stage=path)[node][name] == str(tmp_path / "named.csv")
    (tmp_path / "named.csv").unlink()
    assert shipped_parameters(stage=path)[node][name] == "named.csv"
