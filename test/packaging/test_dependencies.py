"""What is imported, setup.py and package.xml name the same dependencies, by the names in dependencies.yaml."""

import itertools
import re
import shlex
import sys
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from places import REPOSITORY
from test_imports_point_inward import belongs_to_ros, imported

from straightcomp_ros.contract import STREAMS

PACKAGE = "straightcomp_ros"
LISTED = yaml.safe_load((Path(__file__).parent / "dependencies.yaml").read_text(encoding="utf-8"))
LISTED |= {name: {"rosdep": f"python3-{name}"} for name in LISTED.pop("python3-NAME")}
LISTED |= {name: {"no_key": "no key"} for name in LISTED.pop("no key")}
MANIFEST = (REPOSITORY / "package.xml").read_text(encoding="utf-8")
OURS = {PACKAGE, "scripts", "trials", "benchmarks", *(path.stem for path in (REPOSITORY / "test").rglob("*.py"))}
"""Tests import their neighbours by their bare names."""
NOT_NEEDED = {"mcap_ros2", "pandas"}
"""What a bench measures next to our reader where it is installed; pandas also reads a store in a test."""
NO_WHEELS = {"control_msgs", "launch", "launch_ros"}
"""Components of ROS that PyPI has not: the launch files and an action need an installed Jazzy."""
WITH_RCLPY = {"ament_index_python", "builtin_interfaces", "rcl_interfaces", "rosgraph_msgs", "std_msgs"}
"""What rclpy's wheel brings along."""
ONLY_ON_ROS = {"ros2launch"}
"""`ros2 launch` itself: nothing imports it."""


@cache
def imported_by(path):
    """Top names that a Python file imports, apart from the standard library and files of ours."""
    found = {name.partition(".")[0] for name in imported(path.read_text(encoding="utf-8"), (PACKAGE,))}
    return found - OURS - sys.stdlib_module_names - NOT_NEEDED


def foreign_imports(*folders):
    return set().union(*(imported_by(path) for folder in folders for path in (REPOSITORY / folder).rglob("*.py")))


def of_ros(names):
    return set(filter(belongs_to_ros, names))


def by_package():
    # The class of a stream's messages is imported by its name.
    return foreign_imports(PACKAGE, "launch") | {one.layout.type_name.partition("/")[0] for one in STREAMS}


def by_tests():
    return foreign_imports("test", "benchmarks", "trials")


def from_pypi(names):
    return names - of_ros(names)


def names_of(requirements):
    """Without versions: `dask[distributed]` of `dask[distributed]>=1`."""
    return {re.split(r"[<>=!~; ]", requirement)[0].lower() for requirement in requirements}


def pip_names(names):
    return {LISTED[name].get("pip", name) for name in names}


def depends(*kinds):
    root = ElementTree.fromstring(MANIFEST)
    return {str(child.text) for child in root if child.tag in (*(f"{kind}_depend" for kind in kinds), "depend")}


def test_everything_that_is_imported_is_listed_with_a_key_or_the_reason_why_not():
    # psutil is in the text of a test's process.
    assert set(LISTED) - {"psutil"} <= from_pypi(by_package() | by_tests()) <= set(LISTED)
    assert [name for name, entry in LISTED.items() if ("rosdep" in entry) == ("no_key" in entry)] == []


@pytest.fixture
def requirements(setup_arguments):
    """What setup.py requires, and its extras."""
    return setup_arguments["install_requires"], setup_arguments["extras_require"]


def test_setup_requires_what_the_package_imports_and_nothing_else(requirements):
    optional = {name for name in LISTED if "extra" in LISTED[name]}
    required, extras = requirements
    assert pip_names(from_pypi(by_package()) - optional) == names_of(required)
    for extra in ("tuning", "fleet", "opcua"):
        assert pip_names(name for name in optional if LISTED[name]["extra"] == extra) == names_of(extras[extra])
    assert pip_names(from_pypi(by_tests())) <= names_of([*required, *extras["test"], *extras["nightly"]])
    ros = {name.split("[")[0].removeprefix("ros-jazzy-").replace("-", "_") for name in names_of(extras["ros"])}
    assert ros == of_ros(by_package()) - NO_WHEELS - WITH_RCLPY


@pytest.mark.parametrize("wing", ["tuning", "fleet"])
def test_what_an_extra_of_a_wing_brings_is_imported_by_that_wing_alone(wing):
    brought = {name for name, entry in LISTED.items() if entry.get("extra") == wing}
    others = set((REPOSITORY / PACKAGE).rglob("*.py")) - set((REPOSITORY / PACKAGE / wing).rglob("*.py"))
    assert [path for path in others if imported_by(path) & brought] == []


def test_the_manifest_names_each_import_by_its_rosdep_key_or_in_its_pip_line(requirements):
    by_key = {name for name in LISTED if "rosdep" in LISTED[name]}
    for imports, kinds in ((by_package(), ["exec"]), (by_tests(), ["exec", "test"])):
        assert of_ros(imports) | {LISTED[name]["rosdep"] for name in imports & by_key} <= depends(*kinds)
    line = re.search(r"python3 -m pip install ([^;]*);", MANIFEST)
    assert line, "package.xml has no pip line that ends with a semicolon"
    by_pip, (required, extras) = pip_names(from_pypi(by_package()) - by_key), requirements
    wanted = {one for one in (*required, *itertools.chain(*extras.values())) if names_of([one]) <= by_pip}
    # Of the versions that setup.py wants; the shell goes on behind a backslash.
    assert set(shlex.split(line[1].replace("\\\n", " "))) == wanted
    known = {entry["rosdep"] for entry in LISTED.values() if "rosdep" in entry}
    assert depends("exec", "test") <= known | of_ros(by_package() | by_tests()) | ONLY_ON_ROS
