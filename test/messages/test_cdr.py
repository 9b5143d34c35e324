"""Messages and batches: an independent deserialiser reads what is packed, and nothing else is taken for one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from straightcomp_ros.contract import ENCODER, STREAMS
from straightcomp_ros.messages.cdr import (
    ENCAPSULATION,
    LayoutMismatch,
    append_aligned,
    header_stamp_ns,
    joint_state,
    pack_batch,
    read_by_names,
    unpack_batch,
)

TYPES = get_typestore(Stores.ROS2_JAZZY)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
NUMBERS = st.floats(allow_nan=True, allow_infinity=True)


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.topic)
@given(data=st.data(), stamp=STAMPS)
def test_packed_messages_are_read_by_an_independent_deserialiser(stream, data, stamp):
    layout = stream.layout
    numbers = data.draw(st.lists(NUMBERS, min_size=len(layout.columns), max_size=len(layout.columns)))
    packed = layout.pack(stamp, *numbers)
    np.testing.assert_array_equal(read_by_names(layout, TYPES.deserialize_cdr(packed, layout.type_name))[1], numbers)
    read_stamp, read = layout.unpack(packed)
    assert read_stamp == header_stamp_ns(packed) == stamp
    np.testing.assert_array_equal(read, numbers)
    row = np.frombuffer(packed, dtype=layout.dtype)[0]
    assert (row["sec"], row["nanosec"]) == divmod(stamp, 10**9)
    np.testing.assert_array_equal([row[name] for name in layout.columns], numbers)


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.topic)
def test_cut_off_messages_are_refused_at_every_length(stream):
    packed = stream.layout.pack(1, *([0.0] * len(stream.layout.columns)))
    for length in range(len(packed)):
        with pytest.raises(LayoutMismatch):
            stream.layout.unpack(packed[:length])


def test_a_message_with_other_names_is_refused_and_then_read_by_its_names():
    other = joint_state(["platform_y", "stage_x"], position=["y", "x"], effort=["current", "stage"])
    packed = other.pack(5, 2.0, 1.0, 0.25, math.nan)
    with pytest.raises(LayoutMismatch):
        ENCODER.layout.unpack(packed)
    stamp, numbers = read_by_names(ENCODER.layout, TYPES.deserialize_cdr(packed, other.type_name))
    assert stamp == 5 and numbers[:2] == [1.0, 2.0] and numbers[3] == 0.25


SIZE = 12
TIMES = st.integers(0, 2**63 - 1)
MESSAGES = st.lists(st.tuples(TIMES, st.binary(min_size=SIZE, max_size=SIZE)), max_size=20)


@given(MESSAGES, st.binary(max_size=3))
def test_messages_come_out_as_they_went_in_and_the_middleware_s_padding_does_no_harm(messages, padding):
    assert unpack_batch(pack_batch(messages) + padding, SIZE) == messages


def test_rclpy_reads_a_batch_as_what_its_type_says():
    serialization = pytest.importorskip("rclpy.serialization")
    from std_msgs.msg import UInt8MultiArray

    message = UInt8MultiArray(data=b"\x01" + bytes(7) + b"abcdefghijkl")
    batch = pack_batch([(1, b"abcdefghijkl")])
    assert serialization.deserialize_message(batch, UInt8MultiArray) == message
    assert unpack_batch(serialization.serialize_message(message), SIZE) == [(1, b"abcdefghijkl")]


def test_a_batch_that_was_cut_off_is_refused_at_every_length():
    batch = pack_batch([(stamp, bytes(SIZE)) for stamp in range(3)])
    for length in range(len(batch)):
        with pytest.raises(LayoutMismatch):
            unpack_batch(batch[:length], SIZE)


def batch_with(at):
    """A batch of one message, in which a bit of the byte ``at`` is another."""
    batch = bytearray(pack_batch([(1, bytes(SIZE))]))
    batch[at] ^= 1
    return bytes(batch)


@pytest.mark.parametrize(
    "batch, size, words",
    [
        (pack_batch([(1, bytes(SIZE))]), ENCODER.layout.size, "no multiple of 108"),
        # Of another byte order, with dimensions, with an offset.
        *((batch_with(at), SIZE, "not a plain array") for at in (1, 4, 8)),
        # No bag can hold its time.
        (pack_batch([(-1, bytes(SIZE))]), SIZE, "before 1970"),
    ],
)
def test_a_batch_of_another_kind_is_refused(batch, size, words):
    with pytest.raises(LayoutMismatch, match=words):
        unpack_batch(batch, size)


@given(key=st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])), value=st.integers(0, 2**32 - 1))
def test_fields_that_are_appended_one_by_one_are_read_by_an_independent_deserialiser(key, value):
    message = bytearray(ENCAPSULATION)
    append_aligned(message, value, 1, key)
    header = TYPES.deserialize_cdr(bytes(message), "std_msgs/msg/Header")
    assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (np.uint32(value).astype(np.int32), 1, key)
