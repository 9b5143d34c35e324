"""The logger's own services and refusals, with played samples instead of a driver."""

import itertools
import re
import time
import zipfile
from collections import Counter
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from mcap.reader import make_reader
from participant import Participant
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import String
from waiting import comes_true

from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata, read_streams
from straightcomp_ros.bags.topics import TopicQos
from straightcomp_ros.contract import DIAGNOSTICS, DISPLACEMENT, ENCODER, SAFETY_STATE, STAGE_TRAJECTORY, STREAMS
from straightcomp_ros.nodes import logger_node
from straightcomp_ros.nodes.logger_node import FaultIncidents, chosen_topics
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.parameters.node_parameters import LoggerNodeParameters
from straightcomp_ros.runtime.other_topics import OtherTopics, definition_by_files, stored

pytestmark = pytest.mark.keeps_time

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def sample():
    """A message on `encoder`."""
    return ENCODER.layout.pack(time.time_ns(), 0.0, 0.0, 0.0, 0.0)


def test_a_snapshot_saves_the_last_second_and_the_bag_says_what_it_is(single, participant, tmp_path):
    bag = tmp_path / "bag"
    encoder = participant.node.create_publisher(JointState, ENCODER.topic, 10)
    single.start("logger", {"output": str(bag), "snapshot": 1.0, "topics": "encoder|command", "nodes": "logger"})
    participant.until(encoder.get_subscription_count)
    end = time.monotonic() + 2.0
    participant.until(lambda: encoder.publish(sample()) or time.monotonic() > end)
    response = participant.trigger("logger/snapshot")
    assert response.success and int(re.match(r"\d+", response.message)[0]) > 0
    assert single.stop(["logger"])["logger"] == 0
    stream = read_streams(bag, {"encoder": ENCODER.layout})["encoder"]
    assert 0 < np.ptp(stream.log_time) <= 1.0e9
    metadata = read_metadata(bag)
    assert metadata["origin"]["package"] == "straightcomp_ros"
    assert set(metadata["losses"]) == {"/encoder"}
    assert "logger" in read_attachments(bag)["parameters.yaml"].decode()


@pytest.mark.parametrize("stopped", ["", "its bag", "the logger"])
def test_an_incident_has_the_seconds_that_the_logger_keeps_in_memory(single, participant, tmp_path, stopped):
    bag, incidents = tmp_path / "bag", tmp_path / "bag_incidents"
    encoder = participant.node.create_publisher(JointState, ENCODER.topic, 10)
    state = participant.node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
    chosen = {"output": str(bag), "snapshot": 10.0, "incidents": 1, "topics": "encoder", "nodes": "logger"}
    single.start("logger", chosen)
    participant.until(lambda: encoder.get_subscription_count() and state.get_subscription_count())
    state.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, name="tripped"))
    if stopped:
        end = time.monotonic() + 1.0
        participant.until(lambda: encoder.publish(sample()) or time.monotonic() > end)
    if stopped == "its bag":
        assert participant.trigger("logger/stop").success
    if stopped != "the logger":
        participant.until(lambda: encoder.publish(sample()) or list(incidents.glob("*.zip")))
    assert single.stop(["logger"])["logger"] == 0
    assert comes_true(lambda: list(incidents.glob("*.zip")), 120.0)
    with zipfile.ZipFile(next(incidents.iterdir())) as archive:
        archive.extractall(tmp_path / "incident", [name for name in archive.namelist() if name.startswith("bag/")])
    assert len(read_streams(tmp_path / "incident" / "bag", {"encoder": ENCODER.layout})["encoder"]) > 10


def test_what_comes_while_the_logger_is_inactive_is_not_lost(single, participant, tmp_path):
    bag, numbers = tmp_path / "bag", itertools.count()
    encoder = participant.node.create_publisher(JointState, ENCODER.topic, 10)
    recipe = participant.node.create_publisher(String, "/recipe", LATCHED)
    recipe.publish(String(data="steel"))
    topics = {"topics": "encoder", "other_topics": "/recipe", "nodes": ""}
    single.start("logger", {"autostart": False, "output": str(bag), **topics})

    def publish_until(enough):
        participant.until(
            lambda: encoder.publish(ENCODER.layout.pack(10**18 + 500_000 * next(numbers), 0, 0, 0, 0)) or enough()
        )

    assert participant.change("logger", "configure")
    participant.until(recipe.get_subscription_count)
    participant.spin(0.5)
    assert participant.change("logger", "activate")
    publish_until(lambda: size(bag / "bag_0.mcap") > 5000)
    assert participant.change("logger", "deactivate")
    for _ in range(1000):
        next(numbers)
    assert participant.change("logger", "activate")
    before = size(bag / "bag_0.mcap")
    publish_until(lambda: size(bag / "bag_0.mcap") > before + 5000)
    assert single.stop(["logger"])["logger"] == 0
    assert read_metadata(bag)["losses"] == {"/encoder": "0"}
    # What is latched still holds, and comes with each activation.
    assert all(b"steel" in data for data in read_messages(bag, "/recipe").data[:2])
    # Of no nodes' parameters there is one description too.
    with open(bag / "bag_0.mcap", "rb") as file:
        assert Counter(one.name for one in make_reader(file).iter_attachments())["parameters.yaml"] == 1
    # A logger that is to record no feedforward does not warn of its absence.
    said = [line for line in single.log("logger").read_text().splitlines() if "feedforward" in line]
    assert said and not any("WARN" in line for line in said)


def test_a_disk_that_is_nearly_full_ends_the_recording_with_a_whole_bag(single, tmp_path):
    bag = tmp_path / "bag"
    logger = single.start("logger", {"output": str(bag), "min_free_bytes": 10**18})
    assert logger.wait(120) == 1
    assert "min_free_bytes" in single.log("logger").read_text()
    assert (bag / "metadata.yaml").exists()


def test_a_logger_whose_recording_failed_before_it_was_activated_does_not_stay_active(single, participant, tmp_path):
    bag = tmp_path / "bag"
    single.start("logger", {"autostart": False, "output": str(bag), "min_free_bytes": 10**18})
    assert participant.change("logger", "configure")
    participant.until(lambda: "min_free_bytes" in single.log("logger").read_text())
    assert (bag / "metadata.yaml").exists()
    participant.change("logger", "activate")
    participant.until(lambda: participant.state("logger") == "unconfigured")
    assert single.stop(["logger"])["logger"] == 0


def test_recording_obeys_services_stores_how_topics_are_offered_and_keeps_the_newest_incident(single, tmp_path):
    bag, incidents = tmp_path / "bag", tmp_path / "bag_incidents"
    parameters = {"output": str(bag), "nodes": "logger", "record_at_start": False, "topics": "encoder|command"}
    with Participant() as caller:
        state = caller.node.create_publisher(DiagnosticStatus, SAFETY_STATE, LATCHED)
        latched = [caller.node.create_publisher(String, name, LATCHED) for name in ("/recipe", "/gone", "/two", "/two")]
        for number, publisher in enumerate(latched):
            publisher.publish(String(data=f"steel {number}"))
        probe = caller.node.create_publisher(Range, "/probe", 10)
        # Reliable, where the logger asks for best effort: what is stored is how a topic is offered.
        encoder = caller.node.create_publisher(JointState, "/encoder", LATCHED)
        single.start("logger", {**parameters, "other_topics": "/recipe|/gone|/two|/probe", "incidents": 1})
        assert not caller.trigger("logger/stop").success
        assert caller.trigger("logger/start").message.endswith(str(bag))
        assert not caller.trigger("logger/start").success

        def publish_until(enough):
            def publish():
                probe.publish(Range(range=0.25))
                encoder.publish(sample())
                return enough()

            caller.until(publish)

        publish_until(lambda: probe.get_subscription_count() == encoder.get_subscription_count() == 1)
        publish_until(lambda: size(bag / "bag_0.mcap") > 20_000)
        assert caller.trigger("logger/split").success
        publish_until(lambda: size(bag / "bag_1.mcap") > 5000)
        caller.set("logger", {"min_free_bytes": 1_000_001})
        for number, fault in enumerate(("x_jump", "tripped")):
            values = [KeyValue(key="time_ns", value=str(number))]
            state.publish(DiagnosticStatus(level=DiagnosticStatus.ERROR, name=fault, values=values))
            publish_until(lambda fault=fault: [fault in one.name for one in incidents.glob("*.zip")] == [True])
        # A refused start leaves the bag's description as it is.
        assert not caller.trigger("logger/start").success
        caller.node.destroy_publisher(latched[1])
        before = size(bag / "bag_1.mcap")
        publish_until(lambda: size(bag / "bag_1.mcap") > before + 5000)
        assert re.match(r"\d+ messages are in", caller.trigger("logger/stop").message)
        assert (bag / "metadata.yaml").exists()
        assert caller.trigger("logger/start").message.endswith("bag_2")
        publish_until(lambda: size(tmp_path / "bag_2" / "bag_2_0.mcap") > 5000)
    assert single.stop(["logger"])["logger"] == 0
    (file,) = incidents.iterdir()
    with zipfile.ZipFile(file) as archive:
        assert {"INCIDENT.txt", "bag/bag_0.mcap", "doctor.json"} < set(archive.namelist())
    found = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert found["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap"]
    topics = {entry["topic_metadata"]["name"]: entry for entry in found["topics_with_message_count"]}
    # Those that no node sent are listed too.
    assert set(topics) == {"/encoder", "/command", "/recipe", "/gone", "/two", "/probe"}
    assert topics["/encoder"]["message_count"] == len(read_messages(bag, "/encoder").data) > 0
    assert topics["/command"]["message_count"] == 0
    for name in ("/recipe", "/encoder"):
        (qos,) = topics[name]["topic_metadata"]["offered_qos_profiles"]
        assert (qos["durability"], qos["reliability"]) == ("transient_local", "reliable")
        assert (qos["history"], qos["depth"]) in (("keep_last", 1), ("unknown", 0))
    assert set(read_field(bag, Field("/probe", "range")).values) == {0.25}
    assert (tmp_path / "bag_2" / "metadata.yaml").exists()
    assert read_metadata(bag)["parameters_changed"]["logger.min_free_bytes"] == "1000001"
    kept = [read_attachments(folder)["parameters.yaml"].decode() for folder in (bag, tmp_path / "bag_2")]
    assert ["1000001" in one for one in kept] == [False, True]
    # Sent once, before any bag was begun: each has it, as a late subscriber has.
    for folder in ("bag", "bag_2"):
        for name, sent in (("/recipe", {b"0"}), ("/gone", {b"1"}), ("/two", {b"2", b"3"})):
            data = read_messages(tmp_path / folder, name).data
            assert len(data) == len(sent) and {re.search(rb"steel (\d)", one)[1] for one in data} == sent


def test_an_incident_that_is_not_packed_costs_no_older_one(tmp_path, monkeypatch):
    monkeypatch.setattr(logger_node, "_AFTER_S", 0.0)
    older = tmp_path / "bag_incidents" / "2026_01_01-00_00_00_x_jump.zip"
    older.parent.mkdir()
    older.touch()
    log = (node := Mock()).get_logger.return_value
    # There is no such bag.
    incidents = FaultIncidents(node, 1, lambda: tmp_path / "bag")
    incidents._on_safety_state(DiagnosticStatus(name="tripped"))
    _, work = node.create_timer.call_args[0]
    assert comes_true(lambda: work() or log.warning.called, 120.0)
    assert "was not packed" in log.warning.call_args[0][0] and older.exists()


def test_an_incident_is_packed_when_what_was_in_memory_is_in_its_bag(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(logger_node, "_AFTER_S", 0.0)
    monkeypatch.setattr(logger_node, "verb_command", lambda *words: done.append("packs") or ("true",))

    def save():
        for turn in range(3):
            done.append(turn)
            yield

    incidents = FaultIncidents(node := Mock(), 1, lambda: tmp_path / "bag", save)
    _, work = node.create_timer.call_args[0]
    work()
    assert not done
    incidents._on_safety_state(DiagnosticStatus(name="tripped"))
    for _ in range(4):
        work()
    assert done == [0, 1, 2, "packs"]


def test_an_incident_is_of_the_bag_that_was_recorded_at_the_fault_though_another_was_begun_since(tmp_path, monkeypatch):
    bags, packed = [tmp_path / "before"], []
    monkeypatch.setattr(logger_node, "_AFTER_S", 0.0)
    monkeypatch.setattr(logger_node, "verb_command", lambda *words: packed.append(words[1]) or ("true",))
    incidents = FaultIncidents(node := Mock(), 1, lambda: bags[-1])
    _, work = node.create_timer.call_args[0]
    incidents._on_safety_state(DiagnosticStatus(name="tripped"))
    bags.append(tmp_path / "after")
    # A fault in the next bag, while that of the first waits, has an incident of its own.
    incidents._on_safety_state(DiagnosticStatus(name="x_jump"))
    assert comes_true(lambda: work() or packed == [str(bag) for bag in bags], 120.0)


@pytest.mark.parametrize("number", [1, 3, 6])
def test_the_incident_just_packed_is_kept_whatever_the_clock_was_before(tmp_path, monkeypatch, number):
    monkeypatch.setattr(logger_node, "_AFTER_S", 0.0)
    monkeypatch.setattr(logger_node, "verb_command", lambda *words: ("touch", words[-1]))
    folder = tmp_path / "bag_incidents"
    folder.mkdir()
    names = [f"2{year}_01_01-00_00_00_x_jump.zip" for year in (100, 101, 102, 103)]
    for name in names:
        (folder / name).touch()
    (folder / (own := "of_the_user.zip")).touch()
    incidents, packed = FaultIncidents(node := Mock(), number, lambda: tmp_path / "bag"), []
    _, work = node.create_timer.call_args[0]
    for fault in ("tripped", "y_frozen", "z_fault"):
        incidents._on_safety_state(DiagnosticStatus(name=fault))
        packed.insert(0, f"{fault}.zip")
        expected = {own, *packed[:number], *sorted(names, reverse=True)[: max(0, number - len(packed))]}

        def kept(expected=expected):
            work()
            return {one.name if one.name in (own, *names) else one.name[20:] for one in folder.iterdir()} == expected

        assert comes_true(kept, 120.0)


def test_what_a_bag_keeps_of_publishers_that_differ_is_what_all_can_serve():
    best_effort = QoSProfile(depth=7, reliability=ReliabilityPolicy.BEST_EFFORT)
    unknown = QoSProfile(history=HistoryPolicy.UNKNOWN, depth=0)
    assert stored([LATCHED]) == TopicQos("reliable", "transient_local", depth=1)
    assert stored([best_effort, LATCHED]) == TopicQos("best_effort", "volatile", depth=7)
    assert stored([LATCHED, unknown]) == TopicQos("reliable", "volatile", "unknown", 0)


def test_what_can_be_recorded_is_recorded_by_default_and_topics_choose_among_it():
    streams = {one.topic for one in (*STREAMS, DISPLACEMENT)}
    assert chosen_topics(LoggerNodeParameters().topics) == {*streams, STAGE_TRAJECTORY, DIAGNOSTICS}
    assert chosen_topics("diagnostics|displacement|safety_state") == {DIAGNOSTICS, DISPLACEMENT.topic}
    assert chosen_topics("") == set()
    for text in ("safety_state", "/encoder", "encode", "("):
        with pytest.raises(ParameterError, match=rf"'topics': '{re.escape(text)}'.*allowed"):
            chosen_topics(text)


def test_an_expected_topic_is_in_the_bag_from_its_first_publisher_on_and_only_if_it_has_its_type():
    kind, announced, node = DISPLACEMENT.layout.type_name, [], Mock()
    present, publisher = {"/displacement": "sensor_msgs/msg/Range", "/other": kind}, Mock(qos_profile=LATCHED)
    node.get_topic_names_and_types.side_effect = lambda: [(name, [type_name]) for name, type_name in present.items()]
    publishers = node.get_publishers_info_by_topic
    publishers.return_value = [publisher]
    OtherTopics(node, Mock(), re.compile(""), {"/displacement": kind}, [], announced.append)
    _, look = node.create_timer.call_args[0]
    present["/displacement"], publishers.return_value = kind, []
    look()
    assert not announced
    publishers.return_value = [publisher]
    for _ in range(2):
        look()
    assert [(one.name, one.type_name) for one in announced] == [("/displacement", kind)]


def size(file) -> int:
    return file.stat().st_size if file.exists() else 0


def test_a_type_that_ros_2_s_own_packages_lack_is_defined_by_the_files_of_its_package(tmp_path, monkeypatch):
    files = {"Recipe": "std_msgs/Header header\nStep[] steps\n", "Step": "string name\nfloat64 seconds 1.5\n"}
    (tmp_path / "share" / "shop_msgs" / "msg").mkdir(parents=True)
    for name, text in files.items():
        (tmp_path / "share" / "shop_msgs" / "msg" / f"{name}.msg").write_text(text)
    marker = tmp_path / "share" / "ament_index" / "resource_index" / "packages" / "shop_msgs"
    marker.parent.mkdir(parents=True)
    marker.touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    text, type_hash, _ = definition_by_files("shop_msgs/msg/Recipe")
    assert re.findall("MSG: (.*)", str(text)) == ["std_msgs/Header", "builtin_interfaces/Time", "shop_msgs/Step"]
    assert re.fullmatch("RIHS01_[0-9a-f]{64}", type_hash)
    with pytest.raises(LookupError):
        definition_by_files("no_such_msgs/msg/Recipe")
