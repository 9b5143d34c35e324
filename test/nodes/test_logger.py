"""The logger's own services and refusals, with played samples instead of a driver."""

import re
import time
import zipfile

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from participant import Participant
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import String

from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata, read_streams
from straightcomp_ros.bags.topics import TopicQos, definition
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER, SAFETY_STATE
from straightcomp_ros.runtime.other_topics import definition_of_class, stored

pytestmark = pytest.mark.keeps_time

COUNT = 4_000


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Two seconds of samples."""
    path = tmp_path_factory.mktemp("bags") / "samples"
    with BagWriter(path) as bag:
        bag.add_topic("/encoder", ENCODER.layout.type_name)
        for number in range(COUNT):
            stamp = 1_700_000_000_000_000_000 + 500_000 * number
            bag.write("/encoder", ENCODER.layout.pack(stamp, number * 1e-4, 0.0, 0.0, 0.0), stamp, stamp)
    return path


def test_a_snapshot_saves_the_last_second_and_the_bag_says_what_it_is(graph, samples, participant, tmp_path):
    bag = tmp_path / "bag"
    graph.start("logger", {"output": str(bag), "snapshot": 1.0, "topics": "encoder|command", "nodes": "player"})
    player = graph.start("player", {"bag": str(samples), "subscribers": 1})
    assert player.wait(120) == 0
    response = participant.trigger("logger/snapshot")
    assert response.success and int(re.match(r"\d+", response.message)[0]) > 0
    assert graph.stop(["logger"])["logger"] == 0
    stream = read_streams(bag, {"encoder": ENCODER.layout})["encoder"]
    assert 0 < np.ptp(stream.log_time) <= 1.0e9
    metadata = read_metadata(bag)
    assert metadata["origin"]["package"] == "straightcomp_ros"
    assert set(metadata["losses"]) == {"/encoder"}
    assert "player" in read_attachments(bag)["parameters.yaml"].decode()


def test_a_disk_that_is_nearly_full_ends_the_recording_with_a_whole_bag(single, tmp_path):
    bag = tmp_path / "bag"
    logger = single.start("logger", {"output": str(bag), "min_free_bytes": 10**18})
    assert logger.wait(120) == 1
    assert "min_free_bytes" in single.log("logger").read_text()
    assert (bag / "metadata.yaml").exists()


def test_a_latched_fault_packs_an_incident_and_the_oldest_is_removed(graph, participant, tmp_path):
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    state = participant.node.create_publisher(DiagnosticStatus, SAFETY_STATE, latched)
    encoder = participant.node.create_publisher(JointState, ENCODER.topic, 10)
    graph.start("logger", {"output": str(tmp_path / "bag"), "incidents": 1, "nodes": "logger"})
    folder = tmp_path / "bag_incidents"

    def packed(fault):
        encoder.publish(ENCODER.layout.pack(time.time_ns(), 0.0, 0.0, 0.0, 0.0))
        return [one for one in folder.glob("*.zip") if fault in one.name]

    for number, fault in enumerate(("x_jump", "tripped")):
        values = [KeyValue(key="time_ns", value=str(number))]
        state.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, name=fault, values=values))
        participant.until(lambda fault=fault: packed(fault))
    (file,) = folder.iterdir()
    with zipfile.ZipFile(file) as archive:
        assert {"INCIDENT.txt", "bag/bag_0.mcap", "doctor.json"} < set(archive.namelist())
    assert graph.stop(["logger"])["logger"] == 0


def test_recording_starts_stops_and_splits_by_service_and_stores_how_each_topic_was_offered(graph, tmp_path):
    bag = tmp_path / "bag"
    parameters = {"output": str(bag), "nodes": "logger", "record_at_start": False, "topics": "encoder|command"}
    with Participant() as caller:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        caller.node.create_publisher(String, "/recipe", latched).publish(String(data="steel"))
        probe = caller.node.create_publisher(Range, "/probe", 10)
        # Reliable, where the logger asks for best effort: what is stored is how a topic is offered.
        encoder = caller.node.create_publisher(JointState, "/encoder", latched)
        graph.start("logger", {**parameters, "other_topics": "/recipe|/probe"})
        assert not caller.trigger("logger/stop").success
        assert caller.trigger("logger/start").message.endswith(str(bag))
        assert not caller.trigger("logger/start").success

        def publish_until(enough):
            def publish():
                probe.publish(Range(range=0.25))
                encoder.publish(ENCODER.layout.pack(time.time_ns(), 0.0, 0.0, 0.0, 0.0))
                return enough()

            caller.until(publish)

        publish_until(lambda: probe.get_subscription_count() == encoder.get_subscription_count() == 1)
        publish_until(lambda: size(bag / "bag_0.mcap") > 20_000)
        assert caller.trigger("logger/split").success
        publish_until(lambda: size(bag / "bag_1.mcap") > 5000)
        assert re.match(r"\d+ messages are in", caller.trigger("logger/stop").message)
        assert (bag / "metadata.yaml").exists()
        assert caller.trigger("logger/start").message.endswith("bag_2")
        publish_until(lambda: size(tmp_path / "bag_2" / "bag_2_0.mcap") > 5000)
    assert graph.stop(["logger"])["logger"] == 0
    found = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert found["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap"]
    topics = {entry["topic_metadata"]["name"]: entry for entry in found["topics_with_message_count"]}
    # Those that no node sent are listed too.
    assert set(topics) == {"/encoder", "/command", "/recipe", "/probe"}
    assert topics["/encoder"]["message_count"] == len(read_messages(bag, "/encoder").data) > 0
    assert topics["/command"]["message_count"] == 0
    for name in ("/recipe", "/encoder"):
        (qos,) = topics[name]["topic_metadata"]["offered_qos_profiles"]
        assert (qos["durability"], qos["reliability"]) == ("transient_local", "reliable")
        assert (qos["history"], qos["depth"]) in (("keep_last", 1), ("unknown", 0))
    assert set(read_field(bag, Field("/probe", "range")).values) == {0.25}
    assert (tmp_path / "bag_2" / "metadata.yaml").exists()
    # Sent once, before any bag was begun: each has it, as a late subscriber has.
    for folder in ("bag", "bag_2"):
        (recipe,) = read_messages(tmp_path / folder, "/recipe").data
        assert b"steel" in recipe


def test_what_a_bag_keeps_of_publishers_that_differ_is_what_all_can_serve():
    best_effort = QoSProfile(depth=7, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    unknown = QoSProfile(history=HistoryPolicy.UNKNOWN, depth=0)
    assert stored([latched]) == TopicQos("reliable", "transient_local", depth=1)
    assert stored([best_effort, latched]) == TopicQos("best_effort", "volatile", depth=7)
    assert stored([latched, unknown]) == TopicQos("reliable", "volatile", "unknown", 0)


def size(file) -> int:
    return file.stat().st_size if file.exists() else 0


def test_the_definition_of_a_message_class_is_that_of_its_package():
    assert definition_of_class(Range).type_hash == definition("sensor_msgs/msg/Range").type_hash
