"""Messages in batches: what comes out is what went in, and nothing else is taken for a batch."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.contract import ENCODER, STREAMS
from straightcomp_ros.messages.cdr import LayoutMismatch, pack_batch, unpack_batch

SIZE = 12
TIMES = st.integers(0, 2**63 - 1)
MESSAGES = st.lists(st.tuples(TIMES, st.binary(min_size=SIZE, max_size=SIZE)), max_size=20)


@given(MESSAGES)
def test_messages_come_out_as_they_went_in(messages):
    assert unpack_batch(pack_batch(messages), SIZE) == messages


@given(MESSAGES, st.binary(min_size=1, max_size=3))
def test_the_middleware_s_padding_does_no_harm(messages, padding):
    assert unpack_batch(pack_batch(messages) + padding, SIZE) == messages


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.topic)
def test_messages_of_each_stream_are_of_its_layout_s_size(stream):
    data = stream.layout.pack(5, *range(len(stream.layout.columns)))
    [(_, out)] = unpack_batch(pack_batch([(7, data)]), stream.layout.size)
    assert stream.layout.unpack(out) == stream.layout.unpack(data)


def test_rclpy_reads_a_batch_as_what_its_type_says():
    serialization = pytest.importorskip("rclpy.serialization")
    from std_msgs.msg import UInt8MultiArray

    message = UInt8MultiArray(data=b"\x01" + bytes(7) + b"abcdefghijkl")
    batch = pack_batch([(1, b"abcdefghijkl")])
    assert serialization.deserialize_message(batch, UInt8MultiArray) == message
    assert unpack_batch(serialization.serialize_message(message), SIZE) == [(1, b"abcdefghijkl")]


@given(MESSAGES.filter(bool), st.data())
def test_a_batch_that_was_cut_off_is_refused(messages, data):
    batch = pack_batch(messages)
    with pytest.raises(LayoutMismatch):
        unpack_batch(batch[: data.draw(st.integers(0, len(batch) - 1))], SIZE)


def test_a_batch_of_messages_of_another_size_is_refused():
    with pytest.raises(LayoutMismatch, match="no multiple of 108"):
        unpack_batch(pack_batch([(1, bytes(SIZE))]), ENCODER.layout.size)


@pytest.mark.parametrize("at", [1, 4, 8])
def test_an_array_with_dimensions_or_of_another_byte_order_is_refused(at):
    batch = bytearray(pack_batch([(1, bytes(SIZE))]))
    batch[at] ^= 1
    with pytest.raises(LayoutMismatch):
        unpack_batch(bytes(batch), SIZE)


def test_a_batch_with_a_time_before_1970_is_refused_since_no_bag_can_hold_it():
    with pytest.raises(LayoutMismatch, match="before 1970"):
        unpack_batch(pack_batch([(-1, bytes(SIZE))]), SIZE)
