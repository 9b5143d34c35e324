"""Bags of several files: what the writer splits, how others see it, and what readers make of it when a part is gone."""

import errno

import numpy as np
import pytest
from mcap.reader import make_reader
from recording import LAYOUTS, Recording, add_streams, information, messages
from rosbags.rosbag2 import Reader

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.fields import Field, read_field
from straightcomp_ros.bags.folder import bag_files
from straightcomp_ros.bags.mcap_output import McapOutput
from straightcomp_ros.bags.reader import read_attachments, read_messages, read_metadata, read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.bags.topics import TopicQos
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER, STREAMS

COUNT = 1200


@pytest.fixture
def split(record) -> Recording:
    return record(COUNT, "split", max_duration=0.2, chunk_size=20_000)


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
