"""Messages in bursts: what comes out is what went in, and nothing else is taken for a burst."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.contract import ENCODER, STREAMS
from straightcomp_ros.messages.batch import pack_burst, unpack_burst
from straightcomp_ros.messages.cdr import LayoutMismatch

SIZE = 12
TIMES = st.integers(-(2**63), 2**63 - 1)
MESSAGES = st.lists(st.tuples(TIMES, st.binary(min_size=SIZE, max_size=SIZE)), max_size=20)


@given(MESSAGES)
def test_messages_come_out_as_they_went_in(messages):
    assert unpack_burst(pack_burst(messages), SIZE) == messages


@given(MESSAGES, st.binary(min_size=1, max_size=3))
def test_the_middleware_s_padding_does_no_harm(messages, padding):
    assert unpack_burst(pack_burst(messages) + padding, SIZE) == messages


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.topic)
def test_messages_of_each_stream_are_of_its_layout_s_size(stream):
    data = stream.layout.pack(5, *range(len(stream.layout.columns)))
    [(_, out)] = unpack_burst(pack_burst([(7, data)]), stream.layout.size)
    assert stream.layout.unpack(out) == stream.layout.unpack(data)


def test_rclpy_reads_a_burst_as_what_its_type_says():
    serialization = pytest.importorskip("rclpy.serialization")
    from std_msgs.msg import UInt8MultiArray

    message = UInt8MultiArray(data=b"\x01" + bytes(7) + b"abcdefghijkl")
    burst = pack_burst([(1, b"abcdefghijkl")])
    assert serialization.deserialize_message(burst, UInt8MultiArray) == message
    assert unpack_burst(serialization.serialize_message(message), SIZE) == [(1, b"abcdefghijkl")]


@given(MESSAGES.filter(bool), st.data())
def test_a_burst_that_was_cut_off_is_refused(messages, data):
    burst = pack_burst(messages)
    with pytest.raises(LayoutMismatch):
        unpack_burst(burst[: data.draw(st.integers(0, len(burst) - 1))], SIZE)


def test_a_burst_of_messages_of_another_size_is_refused():
    with pytest.raises(LayoutMismatch, match="no multiple of 108"):
        unpack_burst(pack_burst([(1, bytes(SIZE))]), ENCODER.layout.size)


@pytest.mark.parametrize("at", [1, 4, 8])
def test_an_array_with_dimensions_or_of_another_byte_order_is_refused(at):
    burst = bytearray(pack_burst([(1, bytes(SIZE))]))
    burst[at] ^= 1
    with pytest.raises(LayoutMismatch):
        unpack_burst(bytes(burst), SIZE)
