"""A process's place among the participants of Fast DDS, and its profile."""

import mmap
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from contextlib import ExitStack

import pytest
import rclpy

from straightcomp_ros.nodes.middleware import PROFILE_VARIABLE, free_place, own_profile
from straightcomp_ros.share import share_path

NAMESPACE = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"


def words(element):
    """Names and texts of all elements, in their order."""
    return [(part.tag.removeprefix(NAMESPACE), (part.text or "").strip()) for part in element.iter()]


def test_a_place_where_a_port_lies_is_not_taken(tmp_path):
    assert free_place(tmp_path, 0, 5) == 5
    (tmp_path / "fastrtps_port7421").touch()  # 7400 + 11 + 2 * 5
    assert free_place(tmp_path, 0, 5) == 6
    (tmp_path / "fastrtps_port7423_el").touch()  # killed while it was being made
    assert free_place(tmp_path, 0, 5) == 7
    assert free_place(tmp_path, 1, 5) == 5, "other domains have other ports"
    assert free_place(tmp_path, 0, 32 + 4) == 4, "around the circle"


def test_where_ports_lie_everywhere_a_place_is_taken_whose_port_nobody_has_open(tmp_path):
    ports = [tmp_path / f"fastrtps_port{7411 + 2 * place}" for place in range(32)]
    for port in ports:
        port.write_bytes(bytes(4096))
    with ExitStack() as stack:
        for port in (*ports[3:], *ports[:1]):
            with port.open("r+b") as file:
                stack.enter_context(mmap.mmap(file.fileno(), 0))
        assert free_place(tmp_path, 0, 35) == 1
        for port in ports[1:3]:
            with port.open("r+b") as file:
                stack.enter_context(mmap.mmap(file.fileno(), 0))
        assert free_place(tmp_path, 0, 35) == 3, "left to Fast DDS"
    assert free_place(tmp_path, 0, 35) == 3


def test_the_profile_is_the_shipped_one_with_a_place(tmp_path, monkeypatch):
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    with own_profile(shared_memory=tmp_path):
        own = words(ElementTree.parse(os.environ[PROFILE_VARIABLE]).getroot())
    assert PROFILE_VARIABLE not in os.environ
    shipped = words(ElementTree.parse(share_path("config/fastdds.xml")).getroot())
    assert set(own) - set(shipped) == {("participantID", str(os.getpid() % 32))}
    assert [word for word in own if word[0] != "participantID"] == shipped


def test_a_profile_of_the_users_own_stays(tmp_path, monkeypatch):
    monkeypatch.setenv(PROFILE_VARIABLE, "mine.xml")
    with own_profile(shared_memory=tmp_path):
        assert os.environ[PROFILE_VARIABLE] == "mine.xml"
    assert os.environ[PROFILE_VARIABLE] == "mine.xml"


def test_sockets_take_the_place_of_shared_memory_where_all_traffic_stays_on_this_machine(tmp_path, monkeypatch):
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with own_profile(by_sockets=True, shared_memory=tmp_path):
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
        own = words(ElementTree.parse(os.environ[PROFILE_VARIABLE]).getroot())
    assert PROFILE_VARIABLE not in os.environ
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert ("type", "UDPv4") in own
    assert ("type", "SHM") not in own
    # Elsewhere it would not be found: its profile knows no other machine.
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    with own_profile(by_sockets=True, shared_memory=tmp_path):
        assert ("type", "SHM") in words(ElementTree.parse(os.environ[PROFILE_VARIABLE]).getroot())


@pytest.mark.parametrize("by_sockets", [True, False])
def test_under_another_middleware_nothing_is_set_and_the_discovery_range_stays(by_sockets, tmp_path, monkeypatch):
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    before = dict(os.environ)
    with own_profile(by_sockets=by_sockets, shared_memory=tmp_path):
        assert dict(os.environ) == before
    assert dict(os.environ) == before


def test_the_discovery_range_stays_where_the_profile_is_the_users_own(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv(PROFILE_VARIABLE, "mine.xml")
    with own_profile(by_sockets=True, shared_memory=tmp_path):
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"


def test_both_profiles_forget_a_killed_process_after_the_same_time():
    def of(path):
        return [word for word in words(ElementTree.parse(share_path(path)).getroot()) if word[0] in ("sec", "nanosec")]

    assert of("config/fastdds.xml") == of("config/fastdds_loopback.xml")


def test_a_process_with_sockets_opens_no_shared_memory_and_no_socket_beyond_loopback(monkeypatch):
    monkeypatch.delenv(PROFILE_VARIABLE, raising=False)
    script = """
import os, psutil, rclpy
from straightcomp_ros.nodes.middleware import own_profile
with own_profile(by_sockets=True):
    rclpy.init()
    node = rclpy.create_node("any")
process = psutil.Process()
print([entry for entry in os.listdir("/proc/self/fd") if "fastrtps_" in os.path.realpath("/proc/self/fd/" + entry)])
print(sorted({each.laddr.ip for each in process.net_connections("udp")}))
"""
    environment = dict(os.environ, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, timeout=120)
    assert done.stdout.splitlines() == ["[]", "['127.0.0.1']"], done.stderr


def seconds(element):
    """A duration of Fast DDS."""
    return float(element.findtext(f"{NAMESPACE}sec")) + 1e-9 * float(element.findtext(f"{NAMESPACE}nanosec"))


def test_nobody_is_forgotten_while_he_waits_for_the_locks_of_a_killed_process():
    leases = [
        seconds(ElementTree.parse(share_path(f"config/{name}")).find(f".//{NAMESPACE}leaseDuration"))
        for name in ("fastdds.xml", "fastdds_loopback.xml")
    ]
    assert leases[0] == leases[1] > 2.0
