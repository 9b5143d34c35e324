"""A process's profile of Fast DDS: sockets, unless the user has chosen."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
import rclpy

from straightcomp_ros.runtime.middleware import PROFILE_VARIABLES, RANGE_VARIABLE, own_profile
from straightcomp_ros.settings.share import share_path


@pytest.fixture
def unset(monkeypatch):
    for name in (*PROFILE_VARIABLES, RANGE_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


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
        assert {os.environ[name] for name in PROFILE_VARIABLES} == {str(share_path(profile))}
        assert transports(os.environ[PROFILE_VARIABLES[0]]) == ["UDPv4"]
        assert os.environ.get(RANGE_VARIABLE) == given
    assert dict(os.environ) == before


@pytest.mark.parametrize("variable", PROFILE_VARIABLES)
def test_a_profile_of_the_users_own_stays_and_so_does_his_discovery_range(unset, variable):
    unset.setenv(RANGE_VARIABLE, "LOCALHOST")
    unset.setenv(variable, "mine.xml")
    before = dict(os.environ)
    with own_profile():
        assert dict(os.environ) == before
    assert dict(os.environ) == before


def test_under_another_middleware_nothing_is_set_and_the_discovery_range_stays(unset):
    unset.setenv(RANGE_VARIABLE, "LOCALHOST")
    unset.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    before = dict(os.environ)
    with own_profile():
        assert dict(os.environ) == before


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
