"""What stands outside rclpy's documentation: each test names one thing, and fails when a new rclpy has it no more."""

import re
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Int64
from waiting import comes_true

import straightcomp_ros
from straightcomp_ros.runtime import inside_rclpy
from straightcomp_ros.runtime.streams import stream_qos

SECOND = 10**9
# What rclpy does not document begins with an underscore, is its C++ layer, or a handle into that.
PRIVATE = re.compile(r"rclpy\.impl|rclpy_implementation|\.handle\b|(?<!self)(?<!cls)(?<!super\(\))\._[a-z]+\b")
ROS = re.compile(r"^(from|import) rclpy", re.MULTILINE)
FAST_DDS = re.compile(r"^\s*(?:from|import)\s+\S*(?:fastrtps|fastdds|rmw_)", re.MULTILINE)


@pytest.fixture
def node():
    rclpy.init()
    made = LifecycleNode("inside")
    yield made
    made.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def pair(node):
    """Publisher and subscription of one topic, connected."""
    publisher = node.create_publisher(Int64, "any", stream_qos())
    subscription = node.create_subscription(Int64, "any", lambda _: None, stream_qos(), raw=True)
    assert comes_true(publisher.get_subscription_count)
    return publisher, subscription


def test_a_serialised_message_is_published_and_taken_with_the_times_of_the_middleware(node, pair):
    publisher, subscription = pair
    take, wait = inside_rclpy.raw_take(subscription), inside_rclpy.waiter(node, subscription)
    assert take() is None
    # A wait without a message ends in time.
    begin = time.monotonic()
    wait(20_000_000)
    assert time.monotonic() - begin >= 0.019
    before = time.time_ns()
    inside_rclpy.raw_publish(publisher)(serialize_message(Int64(data=42)))
    wait(10 * SECOND)
    data, info = take()
    assert deserialize_message(data, Int64).data == 42
    assert all(before <= info[name] <= time.time_ns() for name in ("source_timestamp", "received_timestamp"))
    assert take() is None


@pytest.mark.parametrize(
    ("sent_ns", "came_ns"), [(900, 1000), (1300, 1300), (9000, 2000)], ids=["long ago", "since", "by a clock ahead"]
)
def test_where_reception_is_stamped_at_the_take_a_message_came_between_its_sending_and_the_take(
    monkeypatch, sent_ns, came_ns
):
    """None had come at 1000, one was taken at 2000."""
    waiting = [None, (b"data", {"source_timestamp": sent_ns, "received_timestamp": 2000, "other": 7})]
    subscription = SimpleNamespace(
        handle=SimpleNamespace(take_message=lambda kind, raw: waiting.pop(0)), msg_type="any kind"
    )
    clock = iter((1000, 2000))
    monkeypatch.setattr(rclpy, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    monkeypatch.setattr(inside_rclpy.time, "time_ns", lambda: next(clock))
    take = inside_rclpy.raw_take(subscription)
    assert take() is None
    assert take() == (b"data", {"source_timestamp": sent_ns, "received_timestamp": came_ns, "other": 7})


def test_state_and_state_service_of_a_lifecycle_node_are_there(node):
    assert inside_rclpy.lifecycle_state(node) == "unconfigured"
    node.trigger_configure()
    assert inside_rclpy.lifecycle_state(node) == "inactive"
    assert inside_rclpy.state_service(node).srv_name.endswith("/change_state")


def test_no_other_file_uses_what_rclpy_does_not_document_and_none_a_package_of_fast_dds():
    found = []
    for file in sorted(Path(straightcomp_ros.__file__).parent.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        assert not FAST_DDS.search(text), file
        if ROS.search(text) and file.name != "inside_rclpy.py":
            found += [f"{file}: {line.strip()}" for line in text.splitlines() if PRIVATE.search(line)]
    assert found == []
