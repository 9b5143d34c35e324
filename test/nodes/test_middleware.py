"""A process's profile of its middleware: sockets on this machine, unless the user has chosen."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
import rclpy

from straightcomp_ros.parameters.middlewares import RANGE_VARIABLE
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.runtime.middleware import middleware_in_words, own_profile

FAST_DDS = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
CYCLONE = "CYCLONEDDS_URI"
LOOPBACK = f"file://{share_path('config/cyclonedds_loopback.xml')}"


@pytest.fixture
def under(monkeypatch):
    """``under(middleware, environment)`` is what `own_profile` sets then, and that it restores what was before."""

    def added(middleware, environment):
        monkeypatch.setattr(rclpy, "get_rmw_implementation_identifier", lambda: middleware)
        for name in (*FAST_DDS, CYCLONE, RANGE_VARIABLE):
            monkeypatch.delenv(name, raising=False)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        before = dict(os.environ)
        with own_profile():
            inside = dict(os.environ)
        assert dict(os.environ) == before
        return dict(inside.items() - before.items())

    return added


def fast_dds(profile, **more):
    return {**dict.fromkeys(FAST_DDS, str(share_path(profile))), **more}


LOCAL, SUBNET, DEFAULT = {RANGE_VARIABLE: "LOCALHOST"}, {RANGE_VARIABLE: "SUBNET"}, "its own default"
FAST, CYCLONE_DDS, OTHER = "rmw_fastrtps_cpp", "rmw_cyclonedds_cpp", "rmw_of_tomorrow"


@pytest.mark.parametrize(
    ("middleware", "environment", "expected", "words"),
    [
        (FAST, LOCAL, fast_dds("config/fastdds_loopback.xml", **{RANGE_VARIABLE: "SYSTEM_DEFAULT"}), ""),
        (FAST, SUBNET, fast_dds("config/fastdds.xml"), ""),
        (FAST, {}, fast_dds("config/fastdds.xml"), ""),
        *((FAST, {**LOCAL, one: "mine.xml"}, {}, "") for one in FAST_DDS),
        (CYCLONE_DDS, LOCAL, {CYCLONE: LOOPBACK}, LOOPBACK),
        (CYCLONE_DDS, {**LOCAL, CYCLONE: "file:///mine.xml"}, {}, CYCLONE),
        (CYCLONE_DDS, {**LOCAL, CYCLONE: ""}, {}, ""),
        (CYCLONE_DDS, SUBNET, {}, ""),
        (CYCLONE_DDS, {}, {}, ""),
        (OTHER, LOCAL, {}, DEFAULT),
        (OTHER, {}, {}, DEFAULT),
    ],
)
def test_a_profile_goes_no_further_than_was_asked_unless_the_user_chose_one_and_the_log_names_it(
    under, middleware, environment, expected, words
):
    assert under(middleware, environment) == expected
    assert middleware_in_words().startswith(f"middleware: {middleware}, profile: {words}")


def test_the_profiles_have_sockets_only_and_those_of_loopback_no_other_interface():
    for profile in ("config/fastdds_loopback.xml", "config/fastdds.xml"):
        tree = ElementTree.parse(share_path(profile))
        assert [one.text for one in tree.iter() if one.tag.endswith("}type")] == ["UDPv4"]
    profile = {
        element.tag.partition("}")[2]: element.attrib.get("name") or element.attrib.get("address") or element.text
        for element in ElementTree.parse(share_path("config/cyclonedds_loopback.xml")).iter()
    }
    assert profile["NetworkInterface"] == "lo" and profile["Peer"] == "localhost"
    assert profile["AllowMulticast"] == "false" and profile["ParticipantIndex"] == "auto"


def test_a_process_opens_no_shared_memory_and_no_socket_beyond_loopback(monkeypatch):
    for name in (*FAST_DDS, CYCLONE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(RANGE_VARIABLE, "LOCALHOST")
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
