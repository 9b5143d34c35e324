"""What the pages say of topics, parameters and commands is what the code has; they build, and their links are right.
Each is of one kind, says for whom it is, and those for users in need have every word that a program prints."""

import ast
import re
import shlex
import subprocess
import sys
from itertools import chain

import pytest
import yaml
from places import REPOSITORY
from places import page as read
from test_imports_point_inward import SOURCE

from scripts import make_reference
from straightcomp_ros import contract
from straightcomp_ros.analysis.judgement import WORDS
from straightcomp_ros.cli.main import make_parser
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.model.paced_motion import StageState
from straightcomp_ros.parameters.declaration import declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.runtime.graph_client import _SERVICES
from straightcomp_ros.runtime.safety_panel import safety_status
from straightcomp_ros.runtime.stage_state import stage_status
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.stage.description import StageParameters
from trials.__main__ import RIGS

PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
LINKING = sorted(
    path for folder in ("docs", "docs/evidence", ".", "bags") for path in (REPOSITORY / folder).glob("*.md")
)
SETS = {STAGE: StageParameters, **NODE_PARAMETERS}
PARAMETERS = {node: {one.name for one in declarations(kind)} for node, kind in SETS.items()}
SHIPPED = shipped_parameters()
OF_ANY_NODE = set().union(*PARAMETERS.values())


def test_every_topic_of_the_contract_stands_in_the_design():
    table = read("design").partition("## Topics")[2].partition("\n## ")[0]
    streams = [one.topic for one in vars(contract).values() if isinstance(one, contract.Stream)]
    slow = [contract.STAGE_TRAJECTORY, contract.DIAGNOSTICS, contract.SAFETY_STATE, contract.TRIP, contract.HEARTBEAT]
    assert set(re.findall(r"^\| `(/?\w+)` \|", table, re.MULTILINE)) == {*streams, *slow}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_parameter_that_is_named_or_that_a_command_sets_exists(page):
    text, groups = page.read_text(encoding="utf-8"), {name.partition(".")[0] for name in OF_ANY_NODE if "." in name}
    for node, _, name in (named.partition(".") for named in re.findall(r"--set[ =]([a-z_.0-9]+)=", text)):
        assert name in PARAMETERS[node], name
    for named in re.findall(r"`([a-z_]+(?:\.[a-z_0-9]+)+)[`=: ]", text):
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


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "QUALITY_DECLARATION.md"], ids=lambda page: page.name)
def test_every_rig_that_is_named_can_be_run_and_every_extra_exists(page, setup_arguments):
    text = page.read_text(encoding="utf-8")
    assert set(re.findall(r"python -m trials ([a-z_]+)", text)) <= set(RIGS)
    assert set(re.findall(r"extra `\[?(\w+)", text)) <= set(setup_arguments["extras_require"])


SCALES = {"ms": 1e-3, "µs": 1e-6, "mm": 1e-3, "µm": 1e-6, "nm": 1e-9, "mA": 1e-3, "%": 1e-2}
STATED = re.compile(r"`([a-z_]+(?:\.[a-z_0-9]+)*)` (?:= |\()(-?\d[\d.]*(?:e-?\d+)?)(?: ([a-zµ%]+))?[),; ]")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_value_of_a_parameter_that_a_page_states_is_the_default_or_the_shipped_one(page):
    """As in `first_size` (0.15), `control.smc_observer.memory` (2 s) or `stage.guide.reversal` (2 mm)."""
    for name, number, unit in STATED.findall(page.read_text(encoding="utf-8")):
        plain = name.removeprefix("stage.")
        meant = [
            (node, one)
            for node, kind in SETS.items()
            for one in declarations(kind)
            if one.kind in (int, float) and f".{one.name}".endswith(f".{plain}")
        ]
        values = [value for node, one in meant for value in (one.default, SHIPPED[node].get(one.name, one.default))]
        assert not meant or any(value == pytest.approx(float(number) * SCALES.get(unit, 1.0)) for value in values), name


def test_the_parameters_that_change_while_a_node_runs_are_those_of_the_table():
    table = read("cell").partition("## Changes while it runs\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (\w+) \| (.*?) \|", table, re.MULTILINE)
    named = {(node, name.removesuffix(".*")) for node, cell in rows for name in re.findall(r"`([\w.*]+)`", cell)}
    assert named == {(node, one) for node, kind in NODE_PARAMETERS.items() for one in getattr(kind, "dynamic", ())}


SECURITY = read("security")
PERMISSIONS = {
    tuple(re.findall(r"`(\w+)`", nodes)): re.findall(r"`([\w/]+)`", what)
    for nodes, what in re.findall(r"^\| (`.*?) \| (.*) \|$", SECURITY, re.MULTILINE)
}
SOURCES = {path.stem.removesuffix("_node"): path for path in SOURCE.glob("nodes/*_node.py")}
"""By node, or process of several."""
SOURCES[contract.COMMISSIONING_CLIENT] = SOURCE / "tuning" / "graph" / "waiting_client.py"


def uses(path):
    """What a module calls, with the names and texts among the arguments; its attributes, and the bases of its classes,
    without any."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            arguments = {getattr(one, "id", getattr(one, "value", None)) for one in node.args}
            yield ast.unparse(node.func).rpartition(".")[2], arguments
        elif isinstance(node, ast.Attribute):
            yield node.attr, set()
        elif isinstance(node, ast.ClassDef):
            yield from ((ast.unparse(base), set()) for base in node.bases)


def those_with(names, argument=None):
    """The processes that use one of these, called with this argument if one is given."""
    return {
        process
        for process, path in SOURCES.items()
        if any(name in names.split() and (argument is None or argument in given) for name, given in uses(path))
    }


@pytest.mark.parametrize(
    ("what", "names", "argument"),
    [
        ("command", "publisher stream_publisher", "COMMAND"),
        ("reference", "publisher stream_publisher", "REFERENCE"),
        ("encoder", "publisher stream_publisher", "ENCODER"),
        ("trip", "tripper", None),
        ("set_parameters_atomically", "RemoteParameters", None),
        ("controller/excite", "service", "controller/excite"),
        ("stage_trajectory", "GraphClient", None),
        ("driver/set_parameters", "GraphClient", None),
        *((service, "GraphClient", None) for service in chain(*_SERVICES.values())),
    ],
)
def test_those_that_may_move_the_machine_by_the_page_of_security_are_those_that_do(what, names, argument):
    may = {node for nodes, allowed in PERMISSIONS.items() if what in allowed for node in nodes}
    assert may == those_with(names, argument)


def test_the_page_of_security_has_each_process_and_each_hidden_node():
    processes = set(re.search(r"for node in (.*?); do", SECURITY)[1].split())
    assert processes == SOURCES.keys() - {contract.COMMISSIONING_CLIENT} | {"commissioning"}
    assert set(re.findall(r"`_(\w+)_subscriptions`", SECURITY)) == those_with("Streams streams GraphClient")


@pytest.mark.parametrize(
    ("constant", "message"),
    [("SAFETY_STATE", safety_status(State.OFF, None, "")), ("STAGE_STATE", stage_status(StageState(), ""))],
)
def test_the_reference_names_each_value_of_a_state(constant, message):
    described = make_reference._texts_below_constants(contract)[constant]
    assert {value.key for value in message.values} <= set(re.findall(r"`(\w+)`", described))


def test_the_reference_is_what_the_code_says():
    """Remedy: python scripts/make_reference.py"""
    assert make_reference.FILE.read_text(encoding="utf-8") == make_reference.reference()
    assert make_reference.TROUBLESHOOTING.read_text(encoding="utf-8") == make_reference.troubleshooting()
    table = read("troubleshooting").partition("## Faults\n")[2].partition("\n## ")[0]
    rows = [[cell.strip("|` ") for cell in line.split(" | ")] for line in table.splitlines() if line.startswith("| `")]
    assert [row[0] for row in rows] == [fault.label for fault in Fault]
    assert all(len(row) == 4 and all(row) for row in rows)


def test_every_service_of_a_node_says_what_it_does():
    offered = list(make_reference.services())
    assert {"driver/enable", "logger/pause"} <= {f"{node}/{name}" for node, name, _, _ in offered}
    assert all(text for _, _, _, text in offered), offered


@pytest.mark.parametrize("page", LINKING, ids=lambda page: page.name)
def test_every_link_inside_leads_somewhere_and_every_file_of_ours_that_is_named_exists(page):
    """Modules, tests, scripts and pages by their path from the root or from the package."""
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)", page.read_text(encoding="utf-8")):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in _anchors(file), f"{target}#{anchor}"
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    folders = ["straightcomp_ros", "test", "scripts", "docs", "config", *(path.name for path in SOURCE.glob("*/"))]
    for name in re.findall(rf"`((?:{'|'.join(folders)})/[\w/]+\.\w+)`", text):
        assert any((root / name).exists() for root in (REPOSITORY, REPOSITORY / "straightcomp_ros")), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_code_in_a_table_has_a_bar(page):
    """It needs a backslash, which HTML pages show: a regular expression that is copied from there matches nothing."""
    rows = re.findall(r"^\|.*", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert not [code for row in rows for code in row.split("`")[1::2] if "|" in code]


def _anchors(page):
    """Those that Markdown's tools give to the headings."""
    headings = re.findall(r"^#+ (.*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


DOCS = REPOSITORY / "docs"
NAVIGATION = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]


def pages(entries):
    """File names in a section of the navigation, in their order."""
    for entry in entries if isinstance(entries, list) else [entries]:
        if isinstance(entry, dict):
            yield from (page for below in entry.values() for page in pages(below))
        else:
            yield entry


KINDS = {page: kind for section in NAVIGATION for kind, below in section.items() for page in pages(below)}


def test_the_overview_leads_to_every_page_and_the_navigation_has_each_once_in_four_kinds_after_it():
    every = sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))
    assert {"index.md", *re.findall(r"\]\(([\w/]+\.md)", read("index"))} == set(every) and sorted(
        pages(NAVIGATION)
    ) == every
    assert list(dict.fromkeys(KINDS.values())) == ["Overview", "Tutorial", "How-to", "Reference", "Explanation"]


@pytest.mark.parametrize("page", sorted(KINDS))
def test_the_first_line_of_a_page_says_its_kind_and_for_whom_it_is(page):
    heading, blank, first = (DOCS / page).read_text(encoding="utf-8").splitlines()[:3]
    assert heading.startswith("# ") and not blank
    assert re.fullmatch(rf"\*{KINDS[page]}, for [^*]+\*", first), first


def test_each_verdict_has_its_row_among_the_symptoms():
    table = read("troubleshooting").partition("## Symptoms of a run\n")[2].partition("\n## ")[0]
    seconds = re.findall(r"^\| .*? \| (.*?) \|", table, re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(seconds))) == set(WORDS)


@pytest.mark.nightly
def test_the_pages_build_without_a_warning(tmp_path):
    """What `make docs` runs."""
    options = re.search(r"-m mkdocs (.*)", (REPOSITORY / "Makefile").read_text(encoding="utf-8"))[1].split()
    assert "--strict" in options
    command = [sys.executable, "-m", "mkdocs", *options, "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stdout + built.stderr
