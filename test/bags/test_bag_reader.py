"""Reading streams: to the last bit what rosbags decodes, whoever wrote the bag."""

from pathlib import Path

import numpy as np
import pytest
from bag_of_rows import STORE, bag_of, by_rosbags, header
from mcap.opcode import Opcode
from recording import LAYOUTS, START_NS, Recording, record, recorded

from straightcomp_ros.bags import BagError, folder
from straightcomp_ros.bags import reader as columns
from straightcomp_ros.bags.reader import StreamColumns, StreamDecoder, read_messages, read_streams, values_at
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import COMMAND, ENCODER, STREAMS
from straightcomp_ros.messages.cdr import read_by_names

JOINT_STATE = "sensor_msgs/msg/JointState"
ENCODER_ONLY = {"encoder": ENCODER.layout}


def bits(values) -> list[int]:
    """NaN is not equal to itself; its bits are."""
    return np.array(values, np.float64).view(np.uint64).tolist()


def joint_state_bytes(names, position=(), effort=(), frame_id="") -> bytes:
    """A JointState as rosbags serialises it."""
    arrays = (np.array(values, np.float64) for values in (position, (), effort))
    message = STORE.types[JOINT_STATE](header(START_NS, frame_id), list(names), *arrays)
    return bytes(STORE.serialize_cdr(message, JOINT_STATE))


def encoder_bag(directory: Path, *contents: bytes, topic: str = "/encoder", published: int = START_NS) -> Path:
    return bag_of(directory, ((topic, JOINT_STATE, one, START_NS + k, published) for k, one in enumerate(contents)))


@pytest.fixture
def without_layouts(monkeypatch):
    """Counts the messages that are decoded one by one."""
    decoded = []

    def counting(layout, message):
        decoded.append(layout)
        return read_by_names(layout, message)

    monkeypatch.setattr(columns, "read_by_names", counting)
    return decoded


@pytest.mark.parametrize("storage", ["zstd", "lz4", "none", "sqlite3"])
def test_every_stream_comes_back_as_rosbags_decodes_it_to_the_last_bit(tmp_path, storage, without_layouts, monkeypatch):
    monkeypatch.setattr(folder, "_AT_ONCE", 70)
    options = {"compression": storage, "chunk_size": 9000} if storage != "sqlite3" else {}
    bag = recorded(tmp_path / "run", 300, **options)
    if storage == "sqlite3":
        written = [message._replace(publish_time=message.log_time) for message in bag.messages]
        kinds = {f"/{stream.topic}": stream.layout.type_name for stream in STREAMS}
        by_rosbags(tmp_path / "theirs", ((topic, kinds[topic], *message) for topic, *message in written))
        bag = Recording(tmp_path / "theirs", written)
    streams = read_streams(bag.directory, LAYOUTS)
    assert list(streams) == list(LAYOUTS)
    assert not without_layouts
    for stream in STREAMS:
        own = [message for message in bag.messages if message.topic == f"/{stream.topic}"]
        expected = [
            read_by_names(stream.layout, STORE.deserialize_cdr(message.data, stream.layout.type_name))
            for message in own
        ]
        found, raw = streams[stream.topic], read_messages(bag.directory, stream.topic)
        assert len(found) == 300 and found.log_time.dtype == found.stamp.dtype == np.int64
        assert found.log_time.tolist() == [message.log_time for message in own]
        assert (raw.publish_time, raw.data) == ([one.publish_time for one in own], [one.data for one in own])
        assert found.stamp.tolist() == [stamp for stamp, _ in expected]
        assert tuple(found.columns) == stream.layout.columns
        for index, array in enumerate(found.columns.values()):
            assert array.dtype == np.float64 and array.flags.writeable and array.flags.c_contiguous
            assert array.view(np.uint64).tolist() == bits([numbers[index] for _, numbers in expected])


def test_any_stamp_comes_back_and_a_publish_time_before_the_epoch_is_recorded_as_0(tmp_path):
    stamps = [-(2**31) * 10**9, -1, 0, 1, 2**31 * 10**9 - 1]
    encoder_bag(tmp_path / "bag", *(ENCODER.layout.pack(stamp, 1, 2, 3, 4) for stamp in stamps), published=-5)
    assert read_streams(tmp_path / "bag", ENCODER_ONLY)["encoder"].stamp.tolist() == stamps
    assert read_messages(tmp_path / "bag", "encoder").publish_time == [0] * len(stamps)


LITTLE = ENCODER.layout.pack(START_NS, 1, 2, 3, 4)
BIG = STORE.serialize_cdr(STORE.deserialize_cdr(LITTLE, JOINT_STATE), JOINT_STATE, little_endian=False)


@pytest.mark.parametrize(
    ("content", "by_names"),
    [
        pytest.param(joint_state_bytes(["platform_y", "stage_x"], [2, 1], [4, 3]), True, id="another order"),
        pytest.param(joint_state_bytes(["stage_x", "platform_y"], [1, 2], [3, 4], "table"), True, id="another frame"),
        pytest.param(joint_state_bytes(["a", "stage_x", "platform_y"], [0, 1, 2], [0, 3, 4]), True, id="more joints"),
        pytest.param(bytes(BIG), True, id="big endian"),
        pytest.param(LITTLE + bytes(3), False, id="bytes behind it"),
    ],
)
def test_a_message_of_another_layout_is_read_by_its_names(tmp_path, without_layouts, content, by_names):
    encoder_bag(tmp_path / "bag", LITTLE, content, LITTLE)
    encoder = read_streams(tmp_path / "bag", ENCODER_ONLY)["encoder"]
    assert np.array(list(encoder.columns.values())).tolist() == [[number] * 3 for number in (1.0, 2.0, 3.0, 4.0)]
    assert encoder.stamp.tolist() == [START_NS] * 3
    assert len(without_layouts) == by_names


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.topic)
def test_a_message_with_a_changed_byte_is_read_as_rosbags_reads_it_or_refused(stream, without_layouts):
    layout, at_once = stream.layout, 0
    clean = layout.pack(START_NS, *range(len(layout.columns)))
    for place in range(len(clean)):
        changed = clean[:place] + bytes([clean[place] ^ 0x20]) + clean[place + 1 :]
        message, decoder = record(Opcode.MESSAGE, bytes(22) + changed), StreamDecoder("topic", layout)
        try:
            stamp, numbers = read_by_names(layout, STORE.deserialize_cdr(changed, layout.type_name))
        except Exception:  # rosbags raises errors of many kinds
            with pytest.raises(BagError):
                decoder.add(message, np.array([0]))
        else:
            without_layouts.clear()
            decoder.add(message, np.array([0]))
            found, at_once = decoder.finished(), at_once + (not without_layouts)
            assert found.stamp.tolist() == [stamp]
            assert bits(np.concatenate([*found.columns.values()])) == bits(numbers)
    # Where only a gap of the alignment, the stamp or a number is another one, nothing is read by its name.
    assert at_once == len(layout.gaps) + 8 * (1 + len(layout.columns))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (joint_state_bytes(["stage_x"], [1], [2]), "lacks position of 'platform_y'"),
        (joint_state_bytes(["stage_x", "platform_y"], [1, 2]), "lacks effort of 'stage_x'"),
        (LITTLE[:8] + (10**9).to_bytes(4, "little") + LITTLE[12:], "lacks a stamp with less than 1e9 nanoseconds"),
        (ENCODER.layout.pack(1, 1, 2, 3, 4)[:-5], "does not decode"),
        (b"", "does not decode"),
        (b"\x00\x07\x00\x00" + bytes(200), "does not decode"),
    ],
)
def test_a_message_that_lacks_what_the_stream_promises_is_refused(tmp_path, content, reason):
    encoder_bag(tmp_path / "bag", content)
    with pytest.raises(BagError, match=f"topic '/encoder': .*{reason}.*allowed is a sensor_msgs/msg/JointState"):
        read_streams(tmp_path / "bag", ENCODER_ONLY)


def test_a_topic_of_another_type_is_refused_and_one_without_messages_left_out(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add(Topic("/encoder", "std_msgs/msg/String"))
        bag.add(Topic("/command", JOINT_STATE))
        bag.write("/encoder", b"\0\1\0\0", 1, 1)
    with pytest.raises(BagError, match=r"'std_msgs/msg/String' .*allowed is sensor_msgs/msg/JointState"):
        read_streams(tmp_path / "bag", ENCODER_ONLY)
    assert read_streams(tmp_path / "bag", {"command": COMMAND.layout}) == {}


def test_a_message_that_rclpy_serialises_is_read(tmp_path):
    pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    serialization = pytest.importorskip("rclpy.serialization")
    sensor_msgs = pytest.importorskip("sensor_msgs.msg")
    message = sensor_msgs.JointState(name=["platform_y"], effort=[0.25])
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 34
    encoder_bag(tmp_path / "bag", serialization.serialize_message(message), topic="/command")
    command = read_streams(tmp_path / "bag", {"command": COMMAND.layout})["command"]
    assert command.stamp.tolist() == [12_000_000_034]
    assert command.columns["control_current"].tolist() == [0.25]


def test_each_sample_gets_the_first_value_of_its_own_stamp_and_none_of_another_or_of_a_stream_without_values():
    def stream(stamps, values):
        stamp = np.array(stamps, np.int64)
        return StreamColumns(stamp, stamp, {"y": np.array(values)})

    wanted = np.array([10, 20, 30, 40], np.int64)
    recorded = stream([30, 15, 10, 30, 45], [3.0, 1.5, 1.0, 9.0, 4.5])
    np.testing.assert_array_equal(values_at(recorded, "y", wanted), [1.0, np.nan, 3.0, np.nan])
    for none in (None, stream([], [])):
        assert np.isnan(values_at(none, "y", wanted)).all()
    assert values_at(stream([10], [1.0]), "y", wanted[:0]).size == 0
