"""What CI asks of every commit besides the tests: types, lint, format, and a manifest that ROS's tools accept."""

import importlib.util
import re
import subprocess
import sys
from importlib.metadata import version
from xml.etree import ElementTree

import pytest
import yaml
from places import REPOSITORY


def _run(module, *arguments):
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"NOT TESTED: {module} is not installed. Remedy: pip install -e '.[test]'")
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments], cwd=REPOSITORY, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_core_passes_mypys_strict_rules():
    judged = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8").partition("[tool.mypy]")[2]
    core = "model control straightness analysis timing hardware messages stage contract.py parameters/declaration.py"
    assert all(f'"straightcomp_ros/{one}",' in judged for one in core.split())
    installed = {name: [*map(int, version(name).split(".")[:2])] for name in ("numpy", "matplotlib")}
    if installed["numpy"] < [2] or installed["matplotlib"] < [3, 8]:
        pytest.skip("NOT TESTED: the types of this NumPy and Matplotlib are not those that are judged")
    _run("mypy")


@pytest.mark.parametrize("words", ["check", "format --check"])
def test_ruff_finds_nothing(words):
    _run("ruff", *words.split(), "--no-cache", ".")


def test_the_manifest_is_one_that_ros_accepts_without_a_warning_and_in_the_order_of_its_schema():
    """What ament_xmllint would say of it, without the network that its schema is fetched from."""
    root = ElementTree.parse(REPOSITORY / "package.xml").getroot()
    order = ["name", "version", "description", "maintainer", "license", "url", "author"]
    order += [f"{kind}depend" for kind in ("build_", "build_export_", "buildtool_", "exec_", "", "doc_", "test_")]
    places = [[*order, "export"].index(child.tag) for child in root]
    assert places == sorted(places)
    depends = [(child.tag, child.text) for child in root if child.tag.endswith("depend")]
    assert len(depends) == len(set(depends))
    assert (REPOSITORY / str(root.find("license").get("file"))).is_file()  # type: ignore[union-attr]
    reason = "NOT TESTED: what ROS says of the manifest; catkin_pkg is not installed"
    catkin_pkg = pytest.importorskip("catkin_pkg.package", reason=reason)
    warnings = []
    package = catkin_pkg.parse_package(str(REPOSITORY / "package.xml"), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings and package.package_format == 3 and re.fullmatch(r"\d+\.\d+\.\d+", package.version)
    assert [export.content for export in package.exports if export.tagname == "build_type"] == ["ament_python"]


def test_every_change_that_no_test_can_notice_is_one_of_a_line_of_the_source():
    for entry in yaml.safe_load((REPOSITORY / "test/equivalent_mutants.yaml").read_text(encoding="utf-8")):
        lines = map(str.strip, (REPOSITORY / entry["file"]).read_text(encoding="utf-8").splitlines())
        assert entry["line"] in lines and entry["mutant"] != entry["line"], entry
