"""Definitions and hashes of message types, against those that ROS 2 itself ships."""

import json
from pathlib import Path

import pytest

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.topics import definition
from straightcomp_ros.contract import STREAMS

TYPES = sorted({stream.layout.type_name for stream in STREAMS} | {"diagnostic_msgs/msg/DiagnosticArray"})


def test_a_definition_is_the_type_followed_by_each_type_it_needs():
    text = definition("sensor_msgs/msg/JointState").text
    parts = text.split("=" * 80 + "\n")
    assert parts[0].splitlines()[:2] == ["std_msgs/Header header", "string[] name"]
    assert [part.splitlines()[0] for part in parts[1:]] == ["MSG: std_msgs/Header", "MSG: builtin_interfaces/Time"]


@pytest.mark.parametrize("type_name", TYPES)
def test_the_type_hash_is_the_one_that_ros_computes(type_name):
    package, _, name = type_name.split("/")
    module = pytest.importorskip(package, reason="the message packages of ROS 2 are not installed")
    installed = Path(module.__file__).parents
    found = [path for folder in list(installed)[:5] for path in folder.glob(f"share/{package}/msg/{name}.json")]
    if not found:
        pytest.skip("the installed message package has no type descriptions")
    hashes = {entry["type_name"]: entry["hash_string"] for entry in json.loads(found[0].read_text())["type_hashes"]}
    assert definition(type_name).type_hash == hashes[type_name]


def test_an_unknown_type_is_refused_by_name():
    with pytest.raises(BagError, match=r"'sensor_msgs/JointState' is unknown: allowed .*sensor_msgs/msg/JointState"):
        definition("sensor_msgs/JointState")
