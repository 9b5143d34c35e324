"""Holds the direction of dependencies: nodes → everything; hardware, bags, analysis → model, control, straightness."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = "straightcomp_ros"
SOURCE = Path(__file__).resolve().parents[2] / PACKAGE
INNER = ("model", "control", "straightness")
MIDDLE = ("hardware", "safety", "bags", "analysis", "timing", "monitoring")
OUTER = ("nodes", "cli")
FORBIDDEN = {
    **dict.fromkeys(INNER, (*MIDDLE, "sweep", *OUTER)),
    **dict.fromkeys(MIDDLE, ("sweep", *OUTER)),
    **dict.fromkeys(("sweep", "paper", "identification", "replay", "bench", "opcua", "view", "doctor"), OUTER),
    "nodes": ("cli",),
    "cli": (),
}
"""What no module of a part reaches, be it through other modules."""
ROS_MODULES = ("rclpy", "launch", "launch_ros", "ament_index_python", "rosidl_runtime_py")
ROS_ENDINGS = ("_msgs", "_srvs", "_interfaces")
BESIDE_THE_PARTS = sorted(SOURCE.glob("*.py"))


def imported(source: str, package: tuple[str, ...], *, only_at_start: bool = False) -> Iterator[str]:
    """Absolute names that a module of ``package`` imports; ``only_at_start`` leaves out those inside functions."""
    pending: list[ast.AST] = [ast.parse(source)]
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


def belongs_to_ros(name: str) -> bool:
    top = name.split(".")[0]
    return top in ROS_MODULES or top.endswith(ROS_ENDINGS)


def part(name: str) -> str:
    """The subpackage of ours that an imported name lies in, or an empty text."""
    pieces = name.split(".")
    return pieces[1] if pieces[0] == PACKAGE and len(pieces) > 1 else ""


def modules(*parts: str) -> list[Path]:
    return sorted(path for name in parts for path in (SOURCE / name).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


@cache
def imports_of(path: Path, *, only_at_start: bool = False) -> tuple[str, ...]:
    package = (PACKAGE, *path.relative_to(SOURCE).parent.parts)
    return tuple(imported(path.read_text(encoding="utf-8"), package, only_at_start=only_at_start))


@cache
def files_of(name: str) -> tuple[Path, ...]:
    """The modules of ours that are executed when the dotted ``name`` is imported."""
    pieces = name.split(".")
    if pieces[0] != PACKAGE:
        return ()
    stems = (SOURCE.joinpath(*pieces[1 : depth + 1]) for depth in range(1, len(pieces)))
    candidates = (path for stem in stems for path in (stem.with_suffix(".py"), stem / "__init__.py"))
    return tuple(path for path in candidates if path.is_file())


def reached_from(path: Path) -> set[str]:
    """Names that are imported by a module, or by a module of ours that it imports, and so on."""
    names: set[str] = set()
    seen, pending = {path}, [path]
    while pending:
        new = set(imports_of(pending.pop())) - names
        names |= new
        files = {file for name in new for file in files_of(name)} - seen
        seen |= files
        pending += files
    return names


@pytest.mark.parametrize("path", [*BESIDE_THE_PARTS, *modules(*(set(FORBIDDEN) - {"nodes"}))], ids=name_of)
def test_only_nodes_know_ros(path: Path) -> None:
    assert [name for name in imports_of(path) if belongs_to_ros(name)] == []


@pytest.mark.parametrize("path", modules("cli"), ids=name_of)
def test_the_command_line_starts_without_ros_and_without_nodes(path: Path) -> None:
    at_start = imports_of(path, only_at_start=True)
    assert [name for name in at_start if belongs_to_ros(name) or part(name) == "nodes"] == []


@pytest.mark.parametrize("path", modules(*FORBIDDEN), ids=name_of)
def test_no_module_reaches_a_part_further_out(path: Path) -> None:
    forbidden = FORBIDDEN[path.relative_to(SOURCE).parts[0]]
    assert sorted(name for name in reached_from(path) if part(name) in forbidden) == []


@pytest.mark.parametrize("path", BESIDE_THE_PARTS, ids=name_of)
def test_modules_beside_the_parts_know_neither_nodes_nor_command_line(path: Path) -> None:
    assert [name for name in imports_of(path) if part(name) in OUTER] == []


def test_every_subpackage_has_its_place_in_the_order() -> None:
    found = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert found <= set(FORBIDDEN), "state in FORBIDDEN what the new part may not import"


@pytest.mark.parametrize(
    "source, names",
    [
        ("import rclpy.node", ["rclpy.node"]),
        ("from ..nodes import clock", ["straightcomp_ros.nodes.clock"]),
        ("from . import plant", ["straightcomp_ros.model.plant"]),
        ("from straightcomp_ros import bags", ["straightcomp_ros.bags"]),
        ("def f():\n    import rclpy", ["rclpy"]),
    ],
)
def test_each_form_of_import_is_seen(source: str, names: list[str]) -> None:
    assert list(imported(source, (PACKAGE, "model"))) == names


def test_imports_inside_functions_are_told_apart() -> None:
    source = "import json\ndef f():\n    import rclpy\nif True:\n    import csv"
    assert sorted(imported(source, (PACKAGE, "cli"), only_at_start=True)) == ["csv", "json"]
