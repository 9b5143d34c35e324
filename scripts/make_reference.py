"""Writes docs/reference.md: topics, services, CAN frames, parameters and the tables of a history, and in
docs/troubleshooting.md the table of faults, from the files that define them."""

import ast
import inspect
import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path

import cantools

from straightcomp_ros import contract
from straightcomp_ros.fleet.history.rows import BagRow, StrokeRow, is_nullable
from straightcomp_ros.fleet.history.store import BAGS, STROKES
from straightcomp_ros.hardware.can import can_parameters, emulator_frames
from straightcomp_ros.messages.cdr import BATCH_TYPE
from straightcomp_ros.parameters.declaration import Declaration, declarations
from straightcomp_ros.parameters.node_parameters import NODE_PARAMETERS, STAGE
from straightcomp_ros.parameters.output_files import write_whole
from straightcomp_ros.parameters.parameter_file import DEFAULT_FILE, DEFAULT_STAGE
from straightcomp_ros.safety.faults import Fault
from straightcomp_ros.stage.description import StageParameters

REPOSITORY = Path(__file__).resolve().parent.parent
FILE = REPOSITORY / "docs" / "reference.md"
TROUBLESHOOTING = REPOSITORY / "docs" / "troubleshooting.md"
SERVES = {"safety_panel": "driver"}
"""Modules with services of one node, and that node."""
ROOMS = [REPOSITORY / "straightcomp_ros" / room for room in ("nodes", "runtime", "tuning/graph")]
HEAD = """\
# Reference

*Reference, for whoever looks up a topic, a service, a parameter, a CAN frame or a column.*

Made by `scripts/make_reference.py` from `contract.py`, `parameters/node_parameters.py`, the nodes, the DBC files and
`fleet/history/`; a test holds it to them. Numbers are SI where no unit is named. All names of topics, services and
nodes are relative: a namespace or a remapping moves them.

## Topics

The streams carry the stamp of the encoder sample that they belong to, best effort, one message for each sample unless
said otherwise.

| topic | type | numbers, in the order of the message | content |
|---|---|---|---|
"""
DBC_FILES = (can_parameters.SHIPPED_DBC, emulator_frames.FILE)
SLOW_TOPIC = re.compile(r"(\w+_msgs)/(\w+)[:,] (.*)", re.DOTALL)
"""How contract.py begins the text below a constant that names a topic which is no stream."""


def reference() -> str:
    """Text of the page."""
    lines = [HEAD.rstrip("\n")]
    for stream in (*contract.STREAMS, *_other_streams()):
        numbers = ", ".join(f"`{name}`" for name in stream.layout.columns)
        lines.append(f"| `{stream.topic}` | {stream.layout.type_name} | {numbers} | {stream.description} |")
    for stream in contract.STREAMS:
        text = f"The messages of `{stream.topic}` in batches; see `straightcomp_ros/messages/cdr.py`."
        lines.append(f"| `{stream.batch_topic}` | {BATCH_TYPE} | | {text} |")
    for constant, text in _texts_below_constants(contract).items():
        found = SLOW_TOPIC.fullmatch(text)
        if found:
            content = _sentence(found[3])
            lines.append(f"| `{getattr(contract, constant)}` | {found[1]}/msg/{found[2]} | | {content} |")
    lines += ["", "## Services", "", "| service | type | what it does |", "|---|---|---|"]
    lines += [f"| `{node}/{name}` | std_srvs/srv/{kind} | {text} |" for node, name, kind, text in services()]
    lines += ["", "## CAN frames", "", "Identifiers are those of node 1; node n adds n − 1.", ""]
    for file in DBC_FILES:
        lines += _frames(file)
    lines += ["## Parameters", ""]
    lines += [f"`{DEFAULT_FILE}` and `{DEFAULT_STAGE}` have them all, with the values that are shipped.", ""]
    described = ", ".join(node for node, kind in NODE_PARAMETERS.items() if STAGE in kind.__annotations__)
    lines += [
        "### The stage",
        "",
        f"Of the nodes {described}. A stage file sets them for all: [the stage](stage.md).",
        "",
    ]
    lines += _parameters(declarations(StageParameters, f"{STAGE}."))
    for node, parameter_set in NODE_PARAMETERS.items():
        own = (one for one in declarations(parameter_set) if not one.name.startswith(f"{STAGE}."))
        lines += [f"### Node {node}", "", *_parameters(own)]
    lines += _history_tables()
    return "\n".join(lines).rstrip("\n") + "\n"


def troubleshooting() -> str:
    """Text of the page of symptoms, with the present table of faults."""
    rows = ((one.label, one.value.means, one.value.causes, one.value.remedy) for one in Fault)
    table = "".join(f"| `{label}` | {' | '.join(texts)} |\n" for label, *texts in rows)
    table = re.sub(r"docs/(\w+\.md)", r"[\1](\1)", table)
    page = TROUBLESHOOTING.read_text(encoding="utf-8")
    return re.sub(r"(^\| `\w+` \|.*\n)+", lambda _: table, page, flags=re.MULTILINE)


def _history_tables() -> list[str]:
    lines = [
        "## Tables of a history",
        "",
        "In a [store](history.md). The unit is at the end of a name. Where the second column has ∅, a value is null if "
        "the bag does not tell it. `strokes` has two columns more, by which its files are sorted into folders: "
        "`stage`, the stage's name, and `month`, YYYY-MM, in which the bag's first stroke began, UTC.",
        "",
    ]
    for table, row in ((STROKES, StrokeRow), (BAGS, BagRow)):
        lines += [f"### Table {table}", "", "| column | | content |", "|---|---|---|"]
        for one in fields(row):
            lines.append(f"| `{one.name}` | {'∅' if is_nullable(one) else ''} | {_cell(one.metadata['description'])} |")
        lines.append("")
    return lines


def _frames(file: str) -> list[str]:
    """The messages of a DBC file, each with the places of its signals."""
    lines = [f"`{file}`, bits in Intel order:", "", "| frame | id | bytes | bits | signal | step | unit | from, to |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for message in cantools.database.load_file(REPOSITORY / file).messages:
        frame = f"{message.name}{', CAN FD' if message.is_fd else ''} | {message.frame_id:#x} | {message.length}"
        for signal in message.signals:
            bits = f"{signal.start}–{signal.start + signal.length - 1}" if signal.length > 1 else str(signal.start)
            choices = (f"{raw} {words}" for raw, words in (signal.choices or {}).items())
            span = (
                ", ".join(choices) or f"{signal.minimum:.10g}, {signal.maximum:.10g}"
                if signal.minimum is not None
                else ""
            )
            lines.append(f"| {frame} | {bits} | {signal.name} | {signal.scale:g} | {signal.unit or ''} | {span} |")
            frame = "| |"
    return [*lines, ""]


def _parameters(declared: Iterable[Declaration]) -> list[str]:
    lines = ["| parameter | default | unit | allowed | meaning |", "|---|---|---|---|---|"]
    for one in declared:
        allowed, meaning = _cell(one.allowed()), _cell(one.description)
        lines.append(f"| `{one.name}` | {_default(one.default)} | {one.unit} | {allowed} | {meaning} |")
    return [*lines, ""]


def _other_streams() -> list[contract.Stream]:
    """Those of the contract that go out neither at the control rate nor in batches."""
    found = [one for one in vars(contract).values() if isinstance(one, contract.Stream)]
    return [one for one in found if one not in contract.STREAMS]


def services() -> Iterator[tuple[str, str, str, str]]:
    """Node, name, type and meaning of each service, from the sources; NODE where each node offers it."""
    for path in sorted((path for room in ROOMS for path in room.glob("*.py")), key=lambda path: path.name):
        name = SERVES.get(path.stem, path.stem.removesuffix("_node"))
        node = name if name in NODE_PARAMETERS else "NODE"
        tree = ast.parse(path.read_text(encoding="utf-8"))
        methods = {one.name: ast.get_docstring(one) or "" for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)}
        for service, kind, method in _offered(tree):
            text = methods[method].split("\n\n")[0]
            yield node, service, kind, _cell(" ".join(text.split()))


def _offered(tree: ast.AST) -> Iterator[tuple[str, str, str]]:
    """Service, type and method of each call that makes services."""
    loops = {id(call): loop for loop in ast.walk(tree) if isinstance(loop, ast.For) for call in ast.walk(loop)}
    for call in ast.walk(tree):
        if not (isinstance(call, ast.Call) and getattr(call.func, "attr", "") in ("create_service", "offer")):
            continue
        kind, name, callback = ast.unparse(call.args[0]), call.args[1], call.args[2]
        if isinstance(name, ast.Constant):
            yield name.value.removeprefix("~/"), kind, _method(callback)
        elif isinstance(name, ast.JoinedStr):
            # In a loop over methods, which have the names of their services, or over the names of steps.
            items = loops[id(call)].iter
            if isinstance(items, ast.Name):
                yield "STEP", kind, callback.args[0].attr  # type: ignore[attr-defined]
            else:
                yield from ((method.strip("_"), kind, method) for method in map(_method, items.elts))  # type: ignore[attr-defined]


def _method(callback: ast.expr) -> str:
    return callback.attr if isinstance(callback, ast.Attribute) else ast.unparse(callback)


def _texts_below_constants(module: object) -> dict[str, str]:
    """The text that stands below each constant of a module."""
    body = ast.parse(inspect.getsource(module)).body  # type: ignore[arg-type]
    return {
        before.targets[0].id: after.value.value
        for before, after in itertools.pairwise(body)
        if isinstance(before, ast.Assign)
        and isinstance(before.targets[0], ast.Name)
        and isinstance(after, ast.Expr)
        and isinstance(after.value, ast.Constant)
        and isinstance(after.value.value, str)
    }


def _sentence(text: str) -> str:
    text = " ".join(text.split())
    return text[:1].upper() + text[1:]


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _default(value: object) -> str:
    return f"`{str(value).lower() if isinstance(value, bool) else repr(value)}`"


if __name__ == "__main__":
    write_whole(FILE, reference())
    write_whole(TROUBLESHOOTING, troubleshooting())
