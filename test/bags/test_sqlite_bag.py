"""Bags that others recorded as SQLite."""

import numpy as np
import pytest
from recording import LAYOUTS, messages
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags import reader as columns
from straightcomp_ros.bags.reader import read_attachments, read_streams
from straightcomp_ros.bags.recovery import recover
from straightcomp_ros.contract import STREAMS

STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def bag(tmp_path):
    with Writer(tmp_path / "other", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        names = {f"/{stream.topic}": f"/machine/{stream.topic}" for stream in STREAMS}
        connections = {
            topic: writer.add_connection(names[topic], LAYOUTS[topic[1:]].type_name, typestore=STORE) for topic in names
        }
        for message in messages(7000):
            writer.write(connections[message.topic], message.log_time, message.data)
    return tmp_path / "other"


def test_its_streams_come_back_to_the_bit_and_by_the_fast_path(bag, monkeypatch):
    monkeypatch.setattr(columns, "read_by_names", None)
    streams = read_streams(bag, LAYOUTS)
    for stream in STREAMS:
        own = [message for message in messages(7000) if message.topic == f"/{stream.topic}"]
        expected = np.array([stream.layout.unpack(message.data)[1] for message in own])
        found = np.array(list(streams[stream.topic].columns.values())).T
        assert found.tobytes() == expected.tobytes()
        assert streams[stream.topic].log_time.tolist() == [message.log_time for message in own]
    assert read_attachments(bag) == {}


def test_other_topic_names_are_given_by_remap(bag):
    layouts = {"encoder": LAYOUTS["encoder"]}
    plain, remapped = read_streams(bag, layouts), read_streams(bag, layouts, {"encoder": "/machine/encoder"})
    assert plain["encoder"].columns["x"].tobytes() == remapped["encoder"].columns["x"].tobytes()
    with pytest.raises(BagError, match="has no topic '/axes' for 'encoder'; it has /machine/command"):
        read_streams(bag, layouts, {"encoder": "/axes"})


def test_a_damaged_file_is_refused(bag):
    path = next(bag.glob("*.db3"))
    content = path.read_bytes()
    path.write_bytes(content[:2000] + b"\xff" * 5000 + content[7000:])
    with pytest.raises(BagError, match="is no SQLite bag of rosbag2, or is damaged"):
        read_streams(bag, LAYOUTS)


def test_a_bag_without_our_topics_is_refused_with_those_that_it_has_and_none_is_recovered(bag, tmp_path):
    with pytest.raises(BagError, match="is stored as sqlite3; this needs MCAP"):
        recover(bag, tmp_path / "new")
    with pytest.raises(BagError, match=r"has no messages on nothing; its topics are /machine/command"):
        read_streams(bag, {"nothing": LAYOUTS["encoder"]})
