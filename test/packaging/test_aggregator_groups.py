"""The groups of config/diagnostic_aggregator.yaml take each status that our nodes publish, and no other."""

import re
from pathlib import Path

import pytest
import yaml

import straightcomp_ros
from straightcomp_ros.parameters.share import share_path

FILE = yaml.safe_load(share_path("config/diagnostic_aggregator.yaml").read_text(encoding="utf-8"))
GROUPS = {name: group for name, group in FILE["/**"]["ros__parameters"].items() if name != "path"}
NODES = [Path(straightcomp_ros.__file__).parent / folder for folder in ("nodes", "tuning/graph")]


def reporting():
    """Names of the nodes that publish diagnostics: their modules are called as the nodes."""
    modules = [path for folder in NODES for path in folder.glob("*_node.py")]
    return sorted(path.stem.removesuffix("_node") for path in modules if " Diagnostics(" in path.read_text("utf-8"))


def matching(status):
    """Groups that take a status, as GenericAnalyzer::match of diagnostic_aggregator does it."""
    return [name for name, group in GROUPS.items() if any(re.fullmatch(one, status) for one in group["regex"])]


def test_all_our_nodes_are_known_here_and_each_group_is_of_the_kind_that_matching_reads():
    for group in GROUPS.values():
        assert group["type"] == "diagnostic_aggregator/GenericAnalyzer"
        assert set(group) == {"type", "path", "regex"}
    assert reporting() == ["commissioning", "controller", "driver", "feedforward", "logger", "opcua", "player"]


@pytest.mark.parametrize("namespace", ["", "line_3/", "hall/line_3/"])
def test_each_status_of_ours_falls_into_one_group_and_no_other_status_into_any(namespace):
    for node in reporting():
        assert len(matching(namespace + node)) == 1, node
    for status in ("controller_manager: Controllers Activity", f"{namespace}camera_driver", "driver/laser"):
        assert matching(status) == []
