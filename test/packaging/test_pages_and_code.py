"""What the pages say of topics, parameters and commands is what the code has."""

import re
import shlex

import pytest
from test_imports_point_inward import SOURCE

from straightcomp_ros import contract
from straightcomp_ros.cli.main import make_parser
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE
from straightcomp_ros.stage.description import StageParameters

REPOSITORY = SOURCE.parent
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
DESIGN = (REPOSITORY / "docs" / "design.md").read_text(encoding="utf-8")
SETS = {STAGE: StageParameters, **NODE_PARAMETERS}
PARAMETERS = {node: {one.name for one in declarations(kind)} for node, kind in SETS.items()}
OF_ANY_NODE = set().union(*PARAMETERS.values())


def test_every_topic_of_the_contract_stands_in_the_design():
    table = DESIGN.partition("## Topics")[2].partition("\n## ")[0]
    streams = [one.topic for one in vars(contract).values() if isinstance(one, contract.Stream)]
    slow = [contract.STAGE_TRAJECTORY, contract.DIAGNOSTICS, contract.SAFETY_STATE, contract.TRIP, contract.HEARTBEAT]
    assert set(re.findall(r"^\| `(/?\w+)` \|", table, re.MULTILINE)) == {*streams, *slow}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_parameter_that_is_named_exists(page):
    groups = {name.partition(".")[0] for name in OF_ANY_NODE if "." in name}
    for named in re.findall(r"`([a-z_]+(?:\.[a-z_0-9]+)+)[`=: ]", page.read_text(encoding="utf-8")):
        node, _, name = named.partition(".")
        if (node in PARAMETERS and name in PARAMETERS[node]) or node not in groups:
            continue
        if not named.endswith((".csv", ".md", ".py", ".xml", ".yaml")):
            assert named in OF_ANY_NODE or any(one.startswith(f"{named}.") for one in OF_ANY_NODE), named


def commands(page):
    """Commands of `straightcomp` on a page: lines in blocks, and code in a sentence."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"```(?:console|sh|text)\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    sentences = re.findall(r"`(straightcomp [^`]*)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    for command in (*lines, *sentences):
        if command.startswith("straightcomp "):
            yield command.partition(" #")[0].rstrip("& ")


@pytest.fixture(scope="module")
def parser():
    return make_parser()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_is_one_that_the_program_takes(page, parser, capsys):
    for command in commands(page):
        # What stands in brackets may be left out; a word in capitals stands for a law or a number.
        words = shlex.split(re.sub(r"\b(N|SAMPLES)\b", "1", re.sub(r"[\[\]…]", "", command).replace("LAW", "smc")))[1:]
        try:
            parser.parse_args(words)
        except SystemExit as end:
            # A verb alone, in a sentence, lacks its arguments.
            lacking = re.search("the following arguments are required", capsys.readouterr().err)
            assert end.code == 0 or (lacking and len(words) <= 3), command


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_parameter_that_a_command_sets_exists(page):
    for named in re.findall(r"--set[ =]([a-z_.0-9]+)=", page.read_text(encoding="utf-8")):
        node, _, name = named.partition(".")
        assert name in PARAMETERS[node], named
