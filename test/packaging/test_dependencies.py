"""Dependencies are told once: what is imported, setup.py and package.xml agree, by the names in dependencies.yaml."""

import re
import runpy
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import setuptools
import yaml
from test_imports_point_inward import PACKAGE, SOURCE, belongs_to_ros, imported

REPOSITORY = SOURCE.parent
LISTED: dict[str, dict[str, str]] = yaml.safe_load(
    (Path(__file__).parent / "dependencies.yaml").read_text(encoding="utf-8")
)
MANIFEST = (REPOSITORY / "package.xml").read_text(encoding="utf-8")
NOT_NEEDED = {"mcap_ros2", "pandas"}
"""What a bench measures beside our reader where somebody has installed it; pandas also reads a store in a test."""
NO_WHEELS = {"launch", "launch_ros"}
"""Parts of ROS that PyPI has not: the launch files need an installed Jazzy."""
WITH_RCLPY = {"builtin_interfaces", "rcl_interfaces", "rosgraph_msgs", "std_msgs"}
"""What rclpy's wheel brings along."""
ONLY_ON_ROS = {"ros2launch"}
"""`ros2 launch` itself: nothing imports it."""


@cache
def foreign_imports(*folders: str) -> set[str]:
    """Top names that the Python files below import, apart from the standard library and files of ours."""
    found: set[str] = set()
    for folder in folders:
        files = sorted((REPOSITORY / folder).rglob("*.py"))
        # Tests import their neighbours by their bare names.
        ours = {PACKAGE, "scripts", *(path.stem for path in files if folder == "test")}
        for path in files:
            names = imported(path.read_text(encoding="utf-8"), (PACKAGE,))
            found |= {name.split(".")[0] for name in names} - ours
    return found - set(sys.stdlib_module_names) - NOT_NEEDED


def of_pypi(names: Iterable[str]) -> set[str]:
    return {name for name in names if not belongs_to_ros(name)}


def by_the_package() -> set[str]:
    return foreign_imports(PACKAGE, "launch")


def by_tests() -> set[str]:
    return foreign_imports("test", "benchmarks")


@pytest.fixture(scope="module")
def setup_arguments() -> dict[str, Any]:
    """What setup.py hands to setuptools."""
    given: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(REPOSITORY)
        patch.setattr(setuptools, "setup", lambda **arguments: given.update(arguments))
        runpy.run_path("setup.py")
    return given


def names_of(requirements: Iterable[str]) -> set[str]:
    """Without versions: `dask[distributed]` of `dask[distributed]>=1`."""
    return {re.split(r"[<>=!~; ]", requirement)[0].lower() for requirement in requirements}


def pip_name(name: str) -> str:
    return LISTED[name].get("pip", name)


def depends(*kinds: str) -> set[str]:
    root = ElementTree.fromstring(MANIFEST)
    return {str(child.text) for child in root if child.tag in (*(f"{kind}_depend" for kind in kinds), "depend")}


def pip_line() -> set[str]:
    """Names in the pip command of package.xml's comment."""
    said = re.search(r"python3 -m pip install ([^;]*);", MANIFEST)
    assert said, "package.xml has no pip line that ends with a semicolon"
    return names_of(word.strip("'") for word in said[1].split())


def test_everything_that_is_imported_is_listed() -> None:
    assert of_pypi(by_the_package() | by_tests()) <= set(LISTED)
    assert set(LISTED) <= by_the_package() | by_tests() | {"psutil"}, "psutil: in the text of a test's process"


def test_setup_requires_what_the_package_imports_and_nothing_else(setup_arguments: dict[str, Any]) -> None:
    optional = {name for name in LISTED if "extra" in LISTED[name]}
    assert {pip_name(name) for name in of_pypi(by_the_package()) - optional} == names_of(
        setup_arguments["install_requires"]
    )
    for name in optional:
        assert pip_name(name) in names_of(setup_arguments["extras_require"][LISTED[name]["extra"]])


def test_the_extra_for_tests_brings_what_tests_import(setup_arguments: dict[str, Any]) -> None:
    brought = names_of([*setup_arguments["install_requires"], *setup_arguments["extras_require"]["test"]])
    assert {pip_name(name) for name in of_pypi(by_tests())} <= brought


def test_the_extra_for_ros_brings_what_is_imported_from_it(setup_arguments: dict[str, Any]) -> None:
    extra = {name.split("[")[0] for name in names_of(setup_arguments["extras_require"]["ros"])}
    from_ros = {name for name in by_the_package() if belongs_to_ros(name)}
    assert {name.removeprefix("ros-jazzy-").replace("-", "_") for name in extra} == from_ros - NO_WHEELS - WITH_RCLPY


def test_the_manifest_names_what_is_imported_from_ros() -> None:
    assert {name for name in by_the_package() if belongs_to_ros(name)} <= depends("exec")
    assert {name for name in by_tests() if belongs_to_ros(name)} <= depends("exec", "test")


def test_the_manifest_names_each_import_by_its_rosdep_key_or_in_its_pip_line() -> None:
    by_key = {name for name in LISTED if "rosdep" in LISTED[name]}
    package, tests = of_pypi(by_the_package()), of_pypi(by_tests())
    assert {LISTED[name]["rosdep"] for name in package & by_key} <= depends("exec")
    assert {LISTED[name]["rosdep"] for name in tests & by_key} <= depends("exec", "test")
    assert {pip_name(name) for name in package - by_key} <= pip_line()


def test_every_key_of_the_manifest_is_one_that_is_known_to_exist_and_is_imported() -> None:
    known = {entry["rosdep"] for entry in LISTED.values() if "rosdep" in entry}
    imports_of_ros = {name for name in by_the_package() | by_tests() if belongs_to_ros(name)}
    assert depends("exec", "test") <= known | imports_of_ros | ONLY_ON_ROS


def test_each_entry_has_a_key_or_the_reason_why_not() -> None:
    assert [name for name, entry in LISTED.items() if ("rosdep" in entry) == ("no_key" in entry)] == []
