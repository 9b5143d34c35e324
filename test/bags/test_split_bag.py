"""Bags of several files: what the writer splits, how others see it, and what readers make of it when a part is gone."""

import errno
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from recording import Recording, add_streams, messages
from rosbags.rosbag2 import Reader

from straightcomp_ros.analysis.evaluation import evaluate_bag
from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.bags.folder import bag_files
from straightcomp_ros.bags.mcap_output import McapOutput
from straightcomp_ros.bags.messages import read_messages
from straightcomp_ros.bags.qos import TopicQos
from straightcomp_ros.bags.reader import read_attachments, read_metadata, read_streams
from straightcomp_ros.bags.recorder import Announced, Recorder, RecorderOptions
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER, STREAMS
from straightcomp_ros.offline.audit import audit

LAYOUTS = {stream.topic: stream.layout for stream in STREAMS}
COUNT = 1200


@pytest.fixture
def split(record) -> Recording:
    return record(COUNT, "split", max_duration=0.2, chunk_size=20_000)


def information(bag: Path) -> dict:
    return yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]


def test_a_bag_is_split_by_duration_and_metadata_lists_its_files_as_rosbag2_does(split):
    files = bag_files(split.directory)
    assert [file.name for file in files] == ["split_0.mcap", "split_1.mcap", "split_2.mcap"]
    found = information(split.directory)
    assert found["relative_file_paths"] == [file.name for file in files]
    assert [entry["path"] for entry in found["files"]] == found["relative_file_paths"]
    assert sum(entry["message_count"] for entry in found["files"]) == found["message_count"] == len(split.messages)
    assert all(entry["duration"]["nanoseconds"] < 0.2e9 for entry in found["files"])
    times = [message.log_time for message in split.messages]
    assert found["starting_time"]["nanoseconds_since_epoch"] == min(times)
    assert found["duration"]["nanoseconds"] == max(times) - min(times)


def test_a_topic_of_one_file_only_is_counted_right_in_the_whole(tmp_path):
    with BagWriter(tmp_path / "run", max_duration=1.0) as bag:
        for topic in ("/always", "/late"):
            bag.add_topic(topic, ENCODER.layout.type_name, TopicQos("best_effort"))
        for second in range(3):
            bag.write("/always", ENCODER.layout.pack(second, 0.0, 0.0, 0.0, 0.0), second * 10**9, second * 10**9)
        bag.write("/late", ENCODER.layout.pack(2, 0.0, 0.0, 0.0, 0.0), 2 * 10**9, 2 * 10**9)
    found = information(tmp_path / "run")
    counts = {each["topic_metadata"]["name"]: each["message_count"] for each in found["topics_with_message_count"]}
    assert len(found["files"]) == 3 and counts == {"/always": 3, "/late": 1}


def test_a_bag_without_messages_begins_when_rosbag2_says_that_nothing_began(tmp_path):
    with BagWriter(tmp_path / "run"):
        pass
    assert information(tmp_path / "run")["starting_time"]["nanoseconds_since_epoch"] == 2**63 - 1


def test_a_chunk_is_of_half_a_mebibyte(tmp_path):
    with BagWriter(tmp_path / "run") as bag:
        bag.add_topic("/encoder", ENCODER.layout.type_name, TopicQos("best_effort"))
        data = bytes(64 * 1024 - 31)  # with the head of its record 64 KiB
        for stamp in range(33):
            bag.write("/encoder", data, stamp, stamp)
    with open(bag_files(tmp_path / "run")[0], "rb") as file:
        summary = make_reader(file).get_summary()
    assert [index.uncompressed_size >> 16 for index in summary.chunk_indexes][:4] == [8, 8, 8, 8]


def test_a_bag_is_one_file_if_nothing_else_is_asked_for(tmp_path):
    data = messages(1)[0].data
    with BagWriter(tmp_path / "run") as bag:
        add_streams(bag)
        for day in range(3):
            for message in range(200):
                time_ns = 86_400_000_000_000 * day + message
                bag.write("/encoder", data, time_ns, time_ns)
    assert [file.name for file in bag_files(tmp_path / "run")] == ["run_0.mcap"]


def test_a_bag_is_split_by_size(record):
    recording = record(COUNT, "large", max_size=60_000, chunk_size=20_000, compression="none")
    sizes = [file.stat().st_size for file in bag_files(recording.directory)]
    assert len(sizes) > 3
    # The chunk that made it so, its index, and the file's own end.
    assert all(60_000 <= size < 110_000 for size in sizes[:-1])


def test_other_readers_and_ours_see_all_messages_in_their_order(split):
    with Reader(split.directory) as reader:
        theirs = [(c.topic, bytes(data)) for c, _, data in reader.messages()]
    # rosbags reads by log time.
    assert sorted(theirs) == sorted((message.topic, message.data) for message in split.messages)
    streams = read_streams(split.directory, LAYOUTS)
    assert all(len(stream) == COUNT for stream in streams.values())
    assert (np.diff(streams["encoder"].stamp) == 500_000).all()
    assert len(read_field(split.directory, Field("encoder", "position[stage_x]")).stamp) == COUNT
    assert len(read_messages(split.directory, "encoder").data) == COUNT
    assert read_metadata(split.directory)["survey"]["points"] == "177"
    assert read_attachments(split.directory)["parameters.yaml"] == b"rate: 2000\n"


def test_each_file_is_a_whole_bag_by_itself(split):
    for file in bag_files(split.directory):
        with file.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert {channel.topic for channel in summary.channels.values()} == {f"/{topic}" for topic in LAYOUTS}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert len(read_streams(file, LAYOUTS)["encoder"]) == summary.statistics.message_count // len(STREAMS)


def test_a_missing_file_is_named_and_recover_saves_the_others(split, tmp_path):
    (split.directory / "split_1.mcap").unlink()
    with pytest.raises(BagError, match=r"lacks split_1\.mcap"):
        read_streams(split.directory, LAYOUTS)
    (split.directory / "metadata.yaml").unlink()
    with pytest.raises(BagError, match=r"lacks split_1\.mcap"):
        read_streams(split.directory, LAYOUTS)
    result = recover(split.directory, tmp_path / "saved")
    assert not result.whole and result.lost is None
    assert ("split_1.mcap", 0, 0, "the file is missing") in result.gaps
    assert 0 < result.saved["/encoder"] < COUNT


def test_the_last_file_of_a_killed_recording_may_be_cut_off_or_empty(split, tmp_path):
    (split.directory / "metadata.yaml").unlink()
    last = split.directory / "split_2.mcap"
    last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    with pytest.warns(UserWarning, match="split_2.mcap was not finished"):
        stream = read_streams(split.directory, LAYOUTS)["encoder"]
    assert 800 <= len(stream) < COUNT
    result = recover(split.directory, tmp_path / "saved")
    assert result.unfinished == ["split_2.mcap"]
    assert result.saved["/encoder"] == len(stream)
    assert len(bag_files(tmp_path / "saved")) == 1
    last.write_bytes(b"")
    assert len(read_streams(split.directory, LAYOUTS)["encoder"]) == 800


def test_a_file_that_cannot_be_opened_leaves_a_finished_bag_of_those_before(tmp_path, monkeypatch):
    written = messages(COUNT)
    with pytest.raises(BagError, match="No space"), BagWriter(tmp_path / "full", max_duration=0.2) as bag:
        add_streams(bag)
        for message in written:
            if message.log_time - written[0].log_time > 0.3e9:
                monkeypatch.setattr(McapOutput, "__init__", refuse)
            bag.write(message.topic, message.data, message.log_time, message.publish_time)
    monkeypatch.undo()
    found = information(tmp_path / "full")
    assert found["relative_file_paths"] == ["full_0.mcap", "full_1.mcap"]
    assert len(read_streams(tmp_path / "full", LAYOUTS)["encoder"]) == found["message_count"] // len(STREAMS)


def refuse(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("option", ["max_size", "max_duration"])
def test_a_negative_limit_is_refused(tmp_path, option):
    with pytest.raises(BagError, match=f"{option} is -1: allowed"):
        BagWriter(tmp_path / "bag", **{option: -1})


def test_evaluation_and_audit_read_a_split_bag(tmp_path):
    sample = Path(__file__).resolve().parents[2] / "bags" / "smc"
    bag = tmp_path / "split"
    with BagWriter(bag, max_size=600_000) as writer, Reader(sample) as reader:
        for connection in reader.connections:
            writer.add_topic(connection.topic, connection.msgtype)
        writer.attach("parameters.yaml", "application/yaml", read_attachments(sample)["parameters.yaml"])
        for connection, time, data in reader.messages():
            writer.write(connection.topic, bytes(data), time, time)
    assert len(bag_files(bag)) > 2
    whole, parts = evaluate_bag(sample), evaluate_bag(bag)
    assert parts.received_samples == whole.received_samples > 5000
    assert parts.record.y.tobytes() == whole.record.y.tobytes()
    found = audit(bag)
    assert found.commands > 5000 and (found.different, found.unverified) == (0, 0)


def announced(recorder: Recorder) -> None:
    recorder.announce(Announced("/encoder", ENCODER.layout.type_name, TopicQos()))


def sample(number: int) -> tuple[str, bytes, int, int]:
    stamp = 10**18 + 500_000 * number
    return "/encoder", ENCODER.layout.pack(stamp, 0.0, 0.0, 0.0, 0.0), stamp, stamp


def test_a_recorder_makes_one_bag_after_the_other_and_counts_no_pause_as_loss(tmp_path):
    described = []
    recorder = Recorder(
        RecorderOptions(str(tmp_path / "run")), ["/encoder"], lambda bag, at_end: described.append(at_end) or at_end
    )
    announced(recorder)
    recorder.intake.add(*sample(0))
    assert recorder.start() == tmp_path / "run"
    with pytest.raises(BagError, match="being recorded already"):
        recorder.start()
    for number in range(100):
        recorder.intake.paused = 20 <= number < 60
        if number != 80:
            recorder.intake.add(*sample(number))
    recorder.stop()
    assert not recorder.recording
    recorder.intake.add(*sample(100))
    assert recorder.start() == tmp_path / "run_2"
    recorder.announce(Announced("/late", "std_msgs/msg/Float64", TopicQos()))
    recorder.intake.add(*sample(101))
    recorder.intake.add("/late", bytes(12), 10**18, 10**18)
    recorder.stop()
    recorder.stop()
    assert len(read_streams(tmp_path / "run", LAYOUTS)["encoder"]) == 59
    metadata = read_metadata(tmp_path / "run")
    assert metadata["losses"] == {"/encoder": "1"}
    assert metadata["logger"] == {"received": "99", "written": "59", "dropped": "0"}
    assert {"package", "version", "revision"} <= set(metadata["origin"])
    counts = {
        t["topic_metadata"]["name"]: t["message_count"]
        for t in information(tmp_path / "run_2")["topics_with_message_count"]
    }
    assert counts == {"/encoder": 1, "/late": 1}
    assert described[-1] is True


def test_an_expected_topic_is_in_each_bag_as_it_was_announced_or_else_as_it_was_expected(tmp_path):
    recorder = Recorder(RecorderOptions(str(tmp_path / "run")), [], lambda bag, at_end: True)
    recorder.expect(Announced("/encoder", ENCODER.layout.type_name, TopicQos("best_effort")))
    recorder.start()
    recorder.stop()
    recorder.start()
    announced(recorder)
    recorder.intake.add(*sample(0))
    recorder.stop()

    def only_topic(folder):
        (topic,) = information(tmp_path / folder)["topics_with_message_count"]
        return topic["topic_metadata"]["offered_qos_profiles"][0]["reliability"], topic["message_count"]

    assert only_topic("run") == ("best_effort", 0)
    assert only_topic("run_2") == ("reliable", 1)


def test_a_full_disk_ends_a_recording_with_what_came_before(tmp_path):
    recorder = Recorder(RecorderOptions(str(tmp_path / "run"), min_free=10**18), [], lambda bag, at_end: True)
    announced(recorder)
    recorder.start()
    recorder._thread.join(30)
    assert "min_free_bytes" in str(recorder.failure)
    recorder.stop()
    assert (tmp_path / "run" / "metadata.yaml").exists()
    shutil.rmtree(tmp_path / "run")
