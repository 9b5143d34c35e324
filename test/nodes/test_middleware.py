"""What lies below the nodes: the middleware's profile, and what rclpy has but does not document."""

import ast
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Int64
from waiting import comes_true

import straightcomp_ros
from straightcomp_ros.parameters.middlewares import RANGE_VARIABLE
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.runtime import inside_rclpy
from straightcomp_ros.runtime.middleware import middleware_in_words, own_profile
from straightcomp_ros.runtime.streams import stream_qos

PROFILE, UNKNOWN = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
"""The name that Jazzy's Fast DDS knows, and the later one that it does not."""
CYCLONE = "CYCLONEDDS_URI"
LOOPBACK = f"file://{share_path('config/cyclonedds_loopback.xml')}"


@pytest.fixture
def under(monkeypatch):
    """``under(middleware, environment)`` is what `own_profile` sets then, and that it restores what was before."""

    def added(middleware, environment):
        monkeypatch.setattr(rclpy, "get_rmw_implementation_identifier", lambda: middleware)
        for name in (PROFILE, UNKNOWN, CYCLONE, RANGE_VARIABLE):
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
    return {PROFILE: str(share_path(profile)), **more}


LOCAL, SUBNET, DEFAULT = {RANGE_VARIABLE: "LOCALHOST"}, {RANGE_VARIABLE: "SUBNET"}, "its own default"
FAST, CYCLONE_DDS, OTHER = "rmw_fastrtps_cpp", "rmw_cyclonedds_cpp", "rmw_of_tomorrow"


@pytest.mark.parametrize(
    ("middleware", "environment", "expected", "words"),
    [
        (FAST, LOCAL, fast_dds("config/fastdds_loopback.xml", **{RANGE_VARIABLE: "SYSTEM_DEFAULT"}), ""),
        (FAST, SUBNET, fast_dds("config/fastdds.xml"), ""),
        (FAST, {}, fast_dds("config/fastdds.xml"), ""),
        (FAST, {UNKNOWN: "mine.xml"}, fast_dds("config/fastdds.xml"), ""),
        (FAST, {**LOCAL, PROFILE: "mine.xml"}, {}, ""),
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
    for name in (PROFILE, CYCLONE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(UNKNOWN, "mine.xml")
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


SECOND = 10**9
ROS = re.compile(r"^(from|import) rclpy", re.MULTILINE)
FAST_DDS = re.compile(r"^\s*(?:from|import)\s+\S*(?:fastrtps|fastdds|rmw_)", re.MULTILINE)


@pytest.fixture
def connected():
    """A node, its publisher and its subscription of one topic."""
    rclpy.init()
    node = LifecycleNode("inside")
    publisher = node.create_publisher(Int64, "any", stream_qos())
    subscription = node.create_subscription(Int64, "any", lambda _: None, stream_qos(), raw=True)
    assert comes_true(publisher.get_subscription_count)
    yield node, publisher, subscription
    node.destroy_node()
    rclpy.try_shutdown()


def test_serialised_messages_are_published_and_taken_with_the_times_of_the_middleware_or_the_failure_is_named(
    connected,
):
    node, publisher, subscription = connected
    take, wait = inside_rclpy.raw_take(subscription), inside_rclpy.waiter(node, subscription)
    assert take() is None
    # A wait without a message ends in time.
    begin = time.monotonic()
    wait(20_000_000)
    assert time.monotonic() - begin >= 0.019
    for number, way in enumerate((inside_rclpy.raw_publish, inside_rclpy.unlocked_publish)):
        publish, before = way(publisher), time.time_ns()
        publish(serialize_message(Int64(data=number)))
        wait(10 * SECOND)
        data, info = take()
        assert deserialize_message(data, Int64).data == number
        assert all(before <= info[name] <= time.time_ns() for name in ("source_timestamp", "received_timestamp"))
        assert take() is None
    rclpy.shutdown()
    with pytest.raises(OSError, match="/any"):
        publish(serialize_message(Int64(data=42)))


def test_a_topic_s_publishers_are_counted_with_the_interpreter_unlocked(connected):
    node, *_ = connected
    count = inside_rclpy.publisher_count(node, node.resolve_topic_name("any"))
    assert count() == 1
    other = node.create_publisher(Int64, "any", stream_qos())
    assert comes_true(lambda: count() == 2)
    node.destroy_publisher(other)
    assert comes_true(lambda: count() == 1)
    assert inside_rclpy.publisher_count(node, "/none")() == 0


@pytest.mark.parametrize(
    ("sent_ns", "nones", "came_ns"),
    [(900, 1, 1000), (1300, 1, 1300), (9000, 1, 2000), (400, 0, 500)],
    ids=["long ago", "since", "by a clock ahead", "before the subscription"],
)
def test_where_reception_is_stamped_at_the_take_a_message_came_between_its_sending_and_the_take(
    monkeypatch, sent_ns, nones, came_ns
):
    """Subscribed at 500; none had come at 1000, if that was looked for; one was taken at 2000."""
    waiting = nones * [None] + [(b"data", {"source_timestamp": sent_ns, "received_timestamp": 2000, "other": 7})]
    subscription = SimpleNamespace(
        handle=SimpleNamespace(take_message=lambda kind, raw: waiting.pop(0)), msg_type="any kind"
    )
    clock = iter((500, *nones * [1000], 2000))
    monkeypatch.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    monkeypatch.setattr(inside_rclpy.time, "time_ns", lambda: next(clock))
    take = inside_rclpy.raw_take(subscription)
    assert [take() for _ in range(nones)] == nones * [None]
    assert take() == (b"data", {"source_timestamp": sent_ns, "received_timestamp": came_ns, "other": 7})


def undocumented(tree):
    """What begins with an underscore, rclpy's C++ layer, and handles into that."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls", "super()"):
            found = re.fullmatch(r"_(?!replace|asdict)[a-z]\w*|handle|impl", node.attr)
        else:
            found = isinstance(node, ast.Import | ast.ImportFrom) and "rclpy.impl" in ast.unparse(node)
        if found:
            yield ast.unparse(node)


def test_no_other_file_uses_what_rclpy_does_not_document_and_none_a_package_of_fast_dds():
    found = []
    for file in sorted(Path(straightcomp_ros.__file__).parent.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        assert not FAST_DDS.search(text), file
        if ROS.search(text) and file.name != "inside_rclpy.py":
            found += [f"{file}: {one}" for one in undocumented(ast.parse(text))]
    assert found == []
