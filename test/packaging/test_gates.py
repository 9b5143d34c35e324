"""What CI asks of every commit beside the tests: types, lint, format, and a manifest that ROS's tools accept."""

import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


def _run(module: str, *arguments: str) -> None:
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"NOT TESTED: {module} is not installed. Remedy: pip install -e '.[test]'")
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], cwd=REPOSITORY, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_core_passes_mypys_strict_rules() -> None:
    _run("mypy")


def test_every_part_of_the_core_is_among_what_mypy_judges() -> None:
    # Python 3.10 has no tomllib; mypy brings tomli along there.
    tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    judged = set(tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["mypy"]["files"])
    parts = (
        "model",
        "control",
        "straightness",
        "analysis",
        "timing",
        "hardware",
        "messages",
        "contract.py",
        "parameters/declaration.py",
    )
    assert {f"straightcomp_ros/{part}" for part in parts} <= judged


def test_ruff_finds_nothing() -> None:
    _run("ruff", "check", "--no-cache", ".")


def test_every_file_is_formatted() -> None:
    _run("ruff", "format", "--check", "--no-cache", ".")


def test_the_manifest_is_one_that_ros_accepts_without_a_warning() -> None:
    catkin_pkg = pytest.importorskip(
        "catkin_pkg.package", reason="NOT TESTED: the manifest; catkin_pkg is not installed"
    )
    warnings: list[str] = []
    package = catkin_pkg.parse_package(str(REPOSITORY / "package.xml"), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert package.package_format == 3
    assert [export.content for export in package.exports if export.tagname == "build_type"] == ["ament_python"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", package.version)


def test_the_manifest_keeps_the_order_of_its_schema_and_names_nothing_twice() -> None:
    """What ament_xmllint would say of it, without the network that its schema is fetched from."""
    root = ElementTree.parse(REPOSITORY / "package.xml").getroot()
    order = ["name", "version", "description", "maintainer", "license", "url", "author"]
    order += [f"{kind}depend" for kind in ("build_", "build_export_", "buildtool_", "exec_", "", "doc_", "test_")]
    order.append("export")
    places = [order.index(child.tag) for child in root]
    assert places == sorted(places)
    depends = [(child.tag, child.text) for child in root if child.tag.endswith("depend")]
    assert len(depends) == len(set(depends))
    assert (REPOSITORY / str(root.find("license").get("file"))).is_file()  # type: ignore[union-attr]
