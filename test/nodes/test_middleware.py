"""A process's profile of its middleware: sockets on this machine, unless the user has chosen."""

import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import rclpy

import straightcomp_ros
from straightcomp_ros.parameters.middlewares import RANGE_VARIABLE
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.runtime.middleware import middleware_in_words, own_profile

FAST_DDS = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
CYCLONE = "CYCLONEDDS_URI"


@pytest.fixture
def unset(monkeypatch):
    for name in (*FAST_DDS, CYCLONE, RANGE_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.fixture
def cyclone(unset):
    unset.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    return unset


def transports(file):
    """Types of the transports in a profile."""
    return [element.text for element in ElementTree.parse(file).iter() if element.tag.endswith("}type")]


@pytest.mark.parametrize(
    ("asked", "profile", "given"),
    [
        ("LOCALHOST", "config/fastdds_loopback.xml", "SYSTEM_DEFAULT"),
        ("SUBNET", "config/fastdds.xml", "SUBNET"),
        (None, "config/fastdds.xml", None),
    ],
)
def test_the_profile_has_sockets_only_and_goes_no_further_than_was_asked(unset, asked, profile, given):
    if asked:
        unset.setenv(RANGE_VARIABLE, asked)
    before = dict(os.environ)
    with own_profile():
        assert {os.environ[name] for name in FAST_DDS} == {str(share_path(profile))}
        assert transports(os.environ[FAST_DDS[0]]) == ["UDPv4"]
        assert os.environ.get(RANGE_VARIABLE) == given
    assert dict(os.environ) == before


@pytest.mark.parametrize("variable", FAST_DDS)
def test_a_profile_of_the_users_own_stays_and_so_does_his_discovery_range(unset, variable):
    unset.setenv(RANGE_VARIABLE, "LOCALHOST")
    unset.setenv(variable, "mine.xml")
    before = dict(os.environ)
    with own_profile():
        assert dict(os.environ) == before
    assert dict(os.environ) == before


def test_cyclone_dds_gets_a_profile_of_the_loopback_interface_alone_and_the_discovery_range_stays(cyclone):
    cyclone.setenv(RANGE_VARIABLE, "LOCALHOST")
    before = dict(os.environ)
    with own_profile():
        added = dict(os.environ.items() - before.items())
    assert dict(os.environ) == before
    assert added == {CYCLONE: f"file://{share_path('config/cyclonedds_loopback.xml')}"}
    profile = {
        element.tag.partition("}")[2]: element.attrib.get("name") or element.attrib.get("address") or element.text
        for element in ElementTree.parse(added[CYCLONE].removeprefix("file://")).iter()
    }
    assert profile["NetworkInterface"] == "lo" and profile["Peer"] == "localhost"
    assert profile["AllowMulticast"] == "false" and profile["ParticipantIndex"] == "auto"


@pytest.mark.parametrize(
    ("asked", "set_by_the_user"), [("LOCALHOST", "file:///mine.xml"), ("LOCALHOST", ""), ("SUBNET", None), (None, None)]
)
def test_cyclone_dds_is_left_to_the_user_on_a_network_and_where_he_has_set_its_profile(cyclone, asked, set_by_the_user):
    for name, value in ((RANGE_VARIABLE, asked), (CYCLONE, set_by_the_user)):
        if value is not None:
            cyclone.setenv(name, value)
    before = dict(os.environ)
    with own_profile():
        assert dict(os.environ) == before


def test_under_an_unknown_middleware_nothing_is_set_and_the_discovery_range_stays(unset):
    unset.setenv(RANGE_VARIABLE, "LOCALHOST")
    unset.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_of_tomorrow")
    before = dict(os.environ)
    with own_profile():
        assert dict(os.environ) == before
    assert middleware_in_words().startswith("middleware: rmw_of_tomorrow, profile: its own default; it does not say")


def test_the_log_names_the_middleware_and_whose_profile_it_has(cyclone):
    cyclone.setenv(RANGE_VARIABLE, "LOCALHOST")
    profile = f"file://{share_path('config/cyclonedds_loopback.xml')}"
    assert middleware_in_words().startswith(f"middleware: rmw_cyclonedds_cpp, profile: {profile}; it does not say")
    cyclone.setenv(CYCLONE, "file:///mine.xml")
    assert middleware_in_words().startswith("middleware: rmw_cyclonedds_cpp, profile: CYCLONEDDS_URI; it does not say")
    cyclone.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_fastrtps_cpp")
    assert middleware_in_words() == (
        f"middleware: rmw_fastrtps_cpp, profile: {share_path('config/fastdds_loopback.xml')}"
    )


def test_no_module_needs_a_package_of_fast_dds():
    imports = re.compile(r"^\s*(?:from|import)\s+\S*(?:fastrtps|fastdds|rmw_)", re.MULTILINE)
    for module in Path(straightcomp_ros.__file__).parent.rglob("*.py"):
        assert not imports.search(module.read_text(encoding="utf-8")), module


def test_a_process_opens_no_shared_memory_and_no_socket_beyond_loopback(unset):
    unset.setenv(RANGE_VARIABLE, "LOCALHOST")
    script = """
import os, psutil, rclpy
from straightcomp_ros.runtime.middleware import own_profile
with own_profile():
    rclpy.init()
    node = rclpy.create_node("any")
process = psutil.Process()
print([entry for entry in os.listdir("/proc/self/fd") if "fastrtps_" in os.path.realpath("/proc/self/fd/" + entry)])
print(sorted({each.laddr.ip for each in process.net_connections("udp")}))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines() == ["[]", "['127.0.0.1']"], done.stderr
