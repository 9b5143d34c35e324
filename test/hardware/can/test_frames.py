"""The packed frames against config/straightcomp.dbc, read by an implementation that is not ours."""

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.hardware.can.emulator_frames import StageReceiver, stage_payloads, truth_of, truth_payload
from straightcomp_ros.hardware.can.frames import (
    ALIVE_MODULUS,
    COUNTER_MODULUS,
    CURRENT_LIMIT,
    X_LIMIT,
    Y_LIMIT,
    Amplifier,
    BoardFault,
    Codec,
    Command,
    Current,
    Encoder,
    FrameError,
    Switch,
    amplifier_of,
    crc_of,
    encoders_valid,
    fault_of,
    start_value,
    status_bits,
)
from straightcomp_ros.hardware.interface import HardwareError, Truth
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.settings.share import share_path

DBC = cantools.database.load_file(share_path("config/straightcomp.dbc"))
CLASSIC, FD = Codec(1, fd=False), Codec(1, fd=True)


@pytest.mark.parametrize(("codec", "ending"), [(CLASSIC, ""), (FD, "Fd")])
def test_frames_have_the_identifiers_of_the_dbc(codec, ending):
    identifiers = {message.name: message.frame_id for message in DBC.messages}
    assert codec.encoder_id == identifiers[f"Encoder{ending}"]
    assert codec.command_id == identifiers[f"Command{ending}"]


def counts(limit):
    return st.one_of(st.sampled_from([-limit, -1, 0, 1, limit]), st.integers(-limit, limit))


alive = st.integers(0, ALIVE_MODULUS - 1)
status = st.builds(status_bits, st.sampled_from(Amplifier), st.sampled_from(BoardFault), st.booleans())
counter = st.one_of(st.sampled_from([0, COUNTER_MODULUS - 1]), st.integers(0, COUNTER_MODULUS - 1))
switch = st.sampled_from(Switch)


def raw(name, payload):
    return DBC.get_message_by_name(name).decode(payload, scaling=False, decode_choices=False)


def encoded(name, signals):
    return DBC.get_message_by_name(name).encode(signals, scaling=False)


def signals_of(frame):
    return {
        "EncoderAlive": frame.alive,
        "Amplifier": amplifier_of(frame.status),
        "BoardFault": fault_of(frame.status),
        "EncodersValid": encoders_valid(frame.status),
        "StageX": frame.x,
        "PlatformY": frame.y,
    }


@given(alive, status, counts(X_LIMIT), counts(Y_LIMIT))
def test_a_classic_encoder_frame_is_what_the_dbc_says(alive, status, x, y):
    frame = Encoder(alive, status, x, y)
    payload = CLASSIC.pack_encoder(frame)
    assert len(payload) == 8
    assert payload == encoded("Encoder", {"EncoderCrc": payload[0], **signals_of(frame)})
    assert CLASSIC.unpack_encoder(payload) == frame


@given(status, counts(X_LIMIT), counts(Y_LIMIT), counts(CURRENT_LIMIT), counter)
def test_an_fd_encoder_frame_is_what_the_dbc_says_and_begins_as_the_classic_one(status, x, y, current, counter):
    frame = Encoder(counter % ALIVE_MODULUS, status, x, y, current, counter)
    payload = FD.pack_encoder(frame)
    expected = {"EncoderCrc": payload[0], **signals_of(frame), "MeasuredCurrent": current, "SampleCounter": counter}
    assert payload == encoded("EncoderFd", expected)
    assert payload[1:8] == CLASSIC.pack_encoder(frame)[1:8]
    assert FD.unpack_encoder(payload) == frame


@given(alive, counts(CURRENT_LIMIT), counter)
def test_a_coil_current_frame_is_what_the_dbc_says(alive, current, counter):
    frame = Current(alive, current, counter)
    payload = CLASSIC.pack_current(frame)
    assert raw("CoilCurrent", payload) == {
        "CoilCurrentCrc": payload[0],
        "CoilCurrentAlive": alive,
        "MeasuredCurrent": current,
        "SampleCounter": counter,
    }
    assert CLASSIC.unpack_current(payload) == frame


@given(
    alive, switch, switch, counts(CURRENT_LIMIT), counter, st.sampled_from([(CLASSIC, "Command"), (FD, "CommandFd")])
)
def test_a_command_frame_is_what_the_dbc_says(alive, enable, reset, current, counter, bus):
    codec, name = bus
    echo = counter if codec.fd else counter % 256
    payload = codec.pack_command(Command(alive, enable, reset, current, counter))
    assert raw(name, payload) == {
        "CommandCrc": payload[0],
        "CommandAlive": alive,
        "Enable": enable,
        "ResetFault": reset,
        "ControlCurrent": current,
        "EchoedCounter": echo,
    }
    assert codec.unpack_command(payload) == Command(alive, enable, reset, current, echo)


@given(switch, switch, counts(CURRENT_LIMIT), counter, st.sampled_from([CLASSIC, FD]))
def test_a_command_whose_alive_counter_is_none_is_refused(enable, reset, current, counter, codec):
    with pytest.raises(FrameError, match="alive"):
        codec.unpack_command(codec.pack_command(Command(ALIVE_MODULUS, enable, reset, current, counter)))


@given(counts(CURRENT_LIMIT), counter)
def test_a_coil_current_whose_counters_are_none_is_refused(current, counter):
    for frame in (Current(ALIVE_MODULUS, current, counter), Current(0, current, COUNTER_MODULUS)):
        with pytest.raises(FrameError, match="alive"):
            CLASSIC.unpack_current(CLASSIC.pack_current(frame))


@pytest.mark.parametrize("sign", [1, -1])
def test_what_does_not_fit_its_frame_is_refused_by_name(sign):
    encoder = Encoder(0, 33, sign * X_LIMIT, sign * Y_LIMIT, sign * CURRENT_LIMIT, 0)
    command = Command(0, Switch.NO, Switch.NO, sign * CURRENT_LIMIT, 0)
    for pack, frame, names in (
        (CLASSIC.pack_encoder, encoder, ("x", "y")),
        (FD.pack_encoder, encoder, ("x", "y", "current")),
        (CLASSIC.pack_current, Current(0, sign * CURRENT_LIMIT, 0), ("current",)),
        (CLASSIC.pack_command, command, ("current",)),
        (FD.pack_command, command, ("current",)),
    ):
        pack(frame)
        for name in names:
            limit = abs(getattr(frame, name))
            beyond = frame._replace(**{name: sign * (limit + 1)})
            with pytest.raises(ValueError, match=f"{name} of {sign * (limit + 1)} counts.*allowed: ±{limit}"):
                pack(beyond)


@pytest.mark.parametrize("codec", [CLASSIC, FD], ids=["classic", "fd"])
def test_a_frame_of_another_length_is_refused(codec):
    frames = [
        (codec.unpack_encoder, codec.pack_encoder(Encoder(0, 33, 1, 2, 3, 0))),
        (codec.unpack_current, codec.pack_current(Current(0, 1, 0))),
        (codec.unpack_command, codec.pack_command(Command(0, Switch.NO, Switch.NO, 1, 0))),
    ]
    for unpack, payload in frames:
        unpack(payload)
        for wrong in (payload[:-1], payload + b"\0", b""):
            with pytest.raises(FrameError, match="length"):
                unpack(wrong)


def test_a_stage_trajectory_is_in_the_units_of_the_dbc():
    motion, time = DBC.get_message_by_name("StageMotion"), DBC.get_message_by_name("StageTime")
    points = forward_and_back(MotionParameters(stroke=1.2, speed=0.25))
    frames = stage_payloads(CLASSIC.ids, points)[:-1]
    for number, point in enumerate(points):
        (first, at), (second, where) = frames[2 * number : 2 * number + 2]
        assert (first, second) == (time.frame_id, motion.frame_id)
        assert time.decode(at) == {"TimeNumber": number, "TimeFromStart": point.time_ns}
        told = motion.decode(where)
        assert told["MotionNumber"] == number
        assert told["Position"] == pytest.approx(point.position, abs=1e-8)
        assert told["Velocity"] == pytest.approx(point.velocity, abs=1e-5)


@given(counter, st.lists(st.floats(allow_nan=False), min_size=6, max_size=6))
def test_a_truth_frame_is_what_the_dbc_says_to_the_last_bit(counter, numbers):
    payload = truth_payload(counter, Truth(*numbers))
    assert [*raw("Truth", payload).values()] == [counter, int.from_bytes(payload[4:8], "little"), *numbers]
    assert truth_of(payload) == (counter, Truth(*numbers))
    with pytest.raises(FrameError):
        truth_of(bytes([payload[0] ^ 1]) + payload[1:])


def test_physical_values_and_identifiers_agree_with_the_dbc():
    payload = FD.pack_encoder(Encoder(3, 33, 17_600_000, -224, -5000, 3))
    values = DBC.get_message_by_name("EncoderFd").decode(payload)
    assert values["StageX"] == pytest.approx(1.76) and values["PlatformY"] == pytest.approx(-22.4e-6)
    assert values["MeasuredCurrent"] == pytest.approx(-0.5)
    names = {message.frame_id: (message.name, message.length, message.is_fd) for message in DBC.messages}
    ids = CLASSIC.ids
    assert names == {
        ids.encoder: ("Encoder", 8, False),
        ids.current: ("CoilCurrent", 8, False),
        ids.command: ("Command", 5, False),
        ids.encoder_fd: ("EncoderFd", 16, True),
        ids.command_fd: ("CommandFd", 8, True),
        ids.heartbeat: ("Heartbeat", 1, False),
        ids.stage_time: ("StageTime", 8, False),
        ids.stage_motion: ("StageMotion", 8, False),
        ids.stage_start: ("StageStart", 5, False),
        ids.truth: ("Truth", 64, True),
    }


@pytest.mark.parametrize("alive, crc", [(0, 0xCC), (1, 0x91)])
def test_the_crc_gives_the_examples_of_autosar_for_data_id_0x123(alive, crc):
    assert crc_of(bytes([0, alive, 0, 0, 0, 0, 0, 0]), start_value(0x123)) == crc


def crc_bit_by_bit(data):
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc


@given(st.integers(0, 0xFFFF), st.sampled_from([5, 8, 16]), st.binary(min_size=16, max_size=16))
def test_the_crc_by_table_is_the_one_taken_bit_by_bit_whatever_stands_in_its_place(data_id, size, payload):
    payload = payload[:size]
    assert crc_of(payload, start_value(data_id)) == crc_bit_by_bit(data_id.to_bytes(2, "little") + payload[1:])


@pytest.mark.parametrize("codec", [CLASSIC, FD], ids=["classic", "fd"])
def test_any_two_wrong_bits_are_found(codec):
    payload = codec.pack_encoder(Encoder(4, 33, 12345, -678, 9, 4))
    whole, size = int.from_bytes(payload, "little"), len(payload)
    for first in range(8 * size):
        for second in range(first, 8 * size):
            wrong = whole ^ (1 << first) ^ (1 << second if second > first else 0)
            with pytest.raises(FrameError, match="crc"):
                codec.unpack_encoder(wrong.to_bytes(size, "little"))


def test_a_frame_under_another_identifier_or_of_another_length_is_refused():
    payload = CLASSIC.pack_encoder(Encoder(4, 33, 1, 2))
    with pytest.raises(FrameError, match="crc"):
        Codec(2, fd=False).unpack_encoder(payload)
    with pytest.raises(FrameError, match="crc"):
        CLASSIC.unpack_current(payload)
    with pytest.raises(FrameError, match="length"):
        CLASSIC.unpack_encoder(payload[:7])


@pytest.mark.parametrize("x, y", [(X_LIMIT + 1, 0), (0, -Y_LIMIT - 1)])
def test_a_number_that_does_not_fit_is_refused_and_not_wrapped(x, y):
    with pytest.raises(ValueError, match="does not fit"):
        CLASSIC.pack_encoder(Encoder(0, 33, x, y))


def test_a_cycle_of_the_stage_survives_its_frames():
    waypoints = forward_and_back(MotionParameters())
    receiver = StageReceiver(CLASSIC.ids)
    *_, received = [receiver.add(*frame) for frame in stage_payloads(CLASSIC.ids, waypoints)]
    sent = Trajectory(waypoints)
    assert received.end_ns == sent.end_ns
    for time_ns in range(0, sent.end_ns, 37_000_000):
        assert received.position(time_ns) == pytest.approx(sent.position(time_ns), abs=3e-8)


def test_a_trajectory_that_lacks_a_frame_or_has_a_damaged_one_is_refused():
    frames = stage_payloads(CLASSIC.ids, forward_and_back(MotionParameters()))
    damaged = [(frames[0][0], frames[0][1][:-1] + b"\1"), *frames[1:]]
    for received in (frames[1:], damaged):
        receiver = StageReceiver(CLASSIC.ids)
        with pytest.raises(HardwareError, match="refused"):
            for frame in received:
                receiver.add(*frame)
