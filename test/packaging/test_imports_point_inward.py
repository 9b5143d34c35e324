"""Imports point downward through the rooms of docs/architecture.md; the servo knows no wing, the core no ROS."""

import ast
import itertools
import re
from functools import cache

from places import REPOSITORY, page

from straightcomp_ros import contract

PACKAGE = "straightcomp_ros"
SOURCE = REPOSITORY / PACKAGE
ARCHITECTURE = page("architecture")
ROOMS, _, PATH_OF_A_SAMPLE = ARCHITECTURE.partition("## The path of one sample")
WINGS = ("tuning", "fleet")
WITH_ROS = ("runtime", "nodes", "bench", "tuning/graph")
COLLECTED = ("node_parameters", "parameter_file")
"""Modules of parameters/ that collect those of all rooms, and stand above them."""
ROS_MODULES = ("rclpy", "launch", "launch_ros", "ament_index_python", "rosidl_runtime_py")
ROS_ENDINGS = ("_msgs", "_srvs", "_interfaces")


def imported(source, package, *, only_at_start=False):
    """Absolute names that a module of ``package`` imports; ``only_at_start`` leaves out those inside functions."""
    pending = [ast.parse(source)]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif not (only_at_start and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)):
            pending.extend(ast.iter_child_nodes(node))


def belongs_to_ros(name):
    top = name.split(".")[0]
    return top in ROS_MODULES or top.endswith(ROS_ENDINGS)


def room(name):
    """The room of ours that an imported name lies in, or an empty text."""
    pieces = [*name.split("."), "", ""]
    if pieces[0] != PACKAGE:
        return ""
    return COLLECTED[0] if pieces[1] == "parameters" and pieces[2] in COLLECTED else pieces[1]


def room_of(path):
    return room(".".join([PACKAGE, *path.relative_to(SOURCE).with_suffix("").parts]))


def modules():
    return sorted(set(SOURCE.rglob("*.py")) - {SOURCE / "__init__.py"})


def name_of(path):
    return path.relative_to(SOURCE).as_posix()


@cache
def imports_of(path, *, only_at_start=False):
    package = (PACKAGE, *path.relative_to(SOURCE).parent.parts)
    return tuple(imported(path.read_text(encoding="utf-8"), package, only_at_start=only_at_start))


@cache
def rows():
    """Names in each row of the picture, from the top."""
    drawn = ROOMS.partition("## Rooms")[2].split("```")[1].removeprefix("text\n")
    return [re.findall(r"\w+", row) for row in re.split(r"\n *│ *\n", drawn)]


def test_the_picture_and_the_table_name_every_room_once():
    drawn = list(itertools.chain(*rows()))
    described = re.findall(r"^\| `(\w+)/?` \|", ROOMS, re.MULTILINE)
    assert len(drawn) == len(set(drawn)) and len(described) == len(set(described))
    assert set(drawn) == set(described) == {room_of(path) for path in modules()}


def modules_in(text):
    """Modules of ours that a text names by room and file."""
    return re.findall(rf"(?<![\w/])((?:{'|'.join(itertools.chain(*rows()))})/[\w/]+\.py)\b", text)


def loaded_by(path):
    """A module and all that it imports from this package, directly or not; the parameters know every node."""
    found, pending = set(), [path]
    while pending:
        path = pending.pop()
        if name_of(path) in found or room_of(path) == COLLECTED[0]:
            continue
        found.add(name_of(path))
        for name in imports_of(path):
            pieces = name.split(".")[1:] if name.split(".")[0] == PACKAGE else []
            places = [SOURCE.joinpath(*pieces[:count]).with_suffix(".py") for count in range(1, len(pieces) + 1)]
            pending.extend(place for place in places if place.is_file())
    return found


def test_each_step_of_a_sample_is_done_by_modules_of_its_process():
    steps = re.findall(r"^\| \d+ \| (\w+) \| (.*)", PATH_OF_A_SAMPLE, re.MULTILINE)
    loaded = {node: loaded_by(SOURCE / "nodes" / f"{node}_node.py") for node, _ in steps}
    strangers = [(node, name) for node, text in steps for name in modules_in(text) if name not in loaded[node]]
    assert len(steps) == 10 and strangers == []


def test_the_topics_of_the_path_are_those_of_the_contract_in_its_order():
    streams = [stream.topic for stream in contract.STREAMS]
    assert re.findall(r"^\| `(\w+)` \| \w+(?:,[^|]*)? \| [\w, ]+ \| ", PATH_OF_A_SAMPLE, re.MULTILINE) == streams
    drawn = re.findall(r"── (\w+) ──", PATH_OF_A_SAMPLE.split("```")[1])
    encoder, reference, command = contract.ENCODER, contract.REFERENCE, contract.COMMAND
    assert drawn == [encoder.topic, encoder.batch_topic, reference.batch_topic, command.topic]


def test_imports_point_downward_or_to_the_same_row_no_wing_imports_the_other_and_nothing_the_trials():
    height = {name: -number for number, row in enumerate(rows()) for name in row}
    pairs = [(path, name) for path in modules() for name in imports_of(path) if room(name)]
    assert len(pairs) > 1000 and rows()[0] == [*WINGS]
    assert [(name_of(path), name) for path, name in pairs if height[room(name)] > height[room_of(path)]] == []
    assert [(name_of(path), name) for path, name in pairs if {room(name), room_of(path)} == {*WINGS}] == []
    assert [
        name_of(path) for path in modules() if any(name.split(".")[0] == "trials" for name in imports_of(path))
    ] == []


def test_only_the_outer_rooms_know_ros():
    core = [path for path in modules() if not name_of(path).startswith(WITH_ROS)]
    assert [(name_of(path), name) for path in core for name in imports_of(path) if belongs_to_ros(name)] == []


def test_the_command_line_starts_without_ros():
    verbs = [path for path in modules() if "verbs" in path.parts or room_of(path) == "cli"]
    started = [(name_of(path), name) for path in verbs for name in imports_of(path, only_at_start=True)]
    assert [one for one in started if belongs_to_ros(one[1]) or room(one[1]) in ("nodes", "runtime")] == []
