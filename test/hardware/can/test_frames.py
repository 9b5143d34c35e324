"""The package's own frames: what they say against config/straightcomp.dbc as cantools reads it, and their CRC."""

import cantools
import pytest
from forgery import forged
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames, StageReceiver
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Command, FrameError, Report
from straightcomp_ros.hardware.interface import HardwareError, Truth
from straightcomp_ros.model.motion import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.parameters.share import share_path

DBC = cantools.database.load_file(share_path("config/straightcomp.dbc"))
EMULATED = cantools.database.load_file(share_path("config/emulator.dbc"))
CLASSIC, FD = (CanParameters(fd=fd).make_wire() for fd in (False, True))
EMULATOR = EmulatorFrames(1, FD)
BUSES = pytest.mark.parametrize("wire", [CLASSIC, FD], ids=["classic", "fd"])
COUNTER_MODULUS = 15 * 2**28

wires = st.sampled_from([CLASSIC, FD])
counts = st.one_of(st.sampled_from([0, COUNTER_MODULUS - 1]), st.integers(0, COUNTER_MODULUS - 1))
reports = st.builds(
    Report,
    st.integers(0, 14),
    counts,
    st.integers(-(2**25) + 1, 2**25 - 1).map(lambda count: count * 1e-7),
    st.integers(-(2**19) + 1, 2**19 - 1).map(lambda count: count * 1e-7),
    st.integers(-(2**15) + 1, 2**15 - 1).map(lambda count: count * 1e-4),
    st.sampled_from(Amplifier),
    st.sampled_from(BoardFault).map(int),
    st.booleans(),
)
commands = st.builds(
    Command,
    st.integers(0, 14),
    st.booleans(),
    st.booleans(),
    st.integers(-(2**15) + 1, 2**15 - 1).map(lambda count: count * 1e-4),
    counts,
)
NAMES = {
    "alive": ("EncoderAlive", "CoilCurrentAlive", "CommandAlive"),
    "counter": ("SampleCounter",),
    "x": ("StageX",),
    "y": ("PlatformY",),
    "current": ("MeasuredCurrent", "ControlCurrent"),
    "amplifier": ("Amplifier",),
    "fault": ("BoardFault",),
    "good": ("EncodersValid",),
    "echo": ("EchoedCounter",),
}


def decoded(name, payload):
    return DBC.get_message_by_name(name).decode(payload, decode_choices=False)


def shown(told, values):
    """Assert that the signals in ``told`` have the values of their fields; returns the fields that are there."""
    found = set()
    for field, names in NAMES.items():
        for name in names:
            if name in told:
                assert told[name] == pytest.approx(float(getattr(values, field)), rel=1e-12)
                found.add(field)
    return found


@given(reports, wires)
def test_what_the_board_reports_is_what_the_dbc_says_and_comes_back(report, wire):
    seen = set()
    for frames in wire.reports.values():
        payload = frames.pack(report, 0)
        seen |= shown(decoded(frames.name, payload), report)
        back = frames.unpack(payload)
        for field, value in zip(Report._fields, back, strict=True):
            assert value is None or field == "good" or value == pytest.approx(getattr(report, field), rel=1e-12)
        if frames is wire.sample:
            assert back.good == report.good and (back.x, back.y) == (report.x, report.y)
    assert seen == set(Report._fields)


@given(commands, wires)
def test_a_command_is_what_the_dbc_says_and_comes_back(command, wire):
    command = command._replace(echo=command.echo % wire.echo_modulus)
    payload = wire.command.pack(command)
    told = decoded(wire.command.name, payload)
    assert shown(told, command) == {"alive", "current", "echo"}
    assert (told["Enable"], told["ResetFault"]) == (1 + command.enable, 1 + command.reset)
    assert wire.command.unpack(payload) == command


def test_an_fd_sample_begins_as_the_classic_one():
    report = Report(4, 49, 1.7, -22e-6, -0.5, Amplifier.ON, 0, True)
    assert FD.sample.pack(report, 0)[1:8] == CLASSIC.sample.pack(report, 0)[1:8]


@BUSES
@pytest.mark.parametrize("sign", [1, -1])
def test_what_does_not_fit_its_frame_is_refused_by_name(wire, sign):
    report = Report(0, 0, 0.0, 0.0, 0.0, Amplifier.OFF, 0, True)
    for field, limit, step in (("x", 2**25 - 1, 1e-7), ("y", 2**19 - 1, 1e-7), ("current", 2**15 - 1, 1e-4)):
        (frames,) = (one for one in wire.reports.values() if field in one.fields)
        frames.pack(report._replace(**{field: sign * limit * step}), 0)
        beyond = sign * (limit + 1) * step
        with pytest.raises(ValueError, match=rf"{field} of {beyond} [mA] does not fit signal.*allowed: -.* to "):
            frames.pack(report._replace(**{field: beyond}), 0)
    assert wire.command.fits("current", sign * 3.2767) and not wire.command.fits("current", sign * 3.2768)


@BUSES
def test_a_frame_of_another_length_or_identifier_is_refused(wire):
    other = CanParameters(fd=wire is FD, node=2).make_wire()
    report = Report(4, 49, 1.7, -22e-6, -0.5, Amplifier.ON, 0, True)
    for frames, payload, twin in (
        (wire.sample, wire.sample.pack(report, 0), other.sample),
        (wire.command, wire.command.pack(Command(3, True, False, 0.1, 7)), other.command),
    ):
        frames.unpack(payload)
        assert twin.identifier == frames.identifier + 1
        with pytest.raises(FrameError, match="crc"):
            twin.unpack(payload)
        for wrong in (payload[:-1], payload + b"\0", b""):
            with pytest.raises(FrameError, match="length"):
                frames.unpack(wrong)


@BUSES
def test_counters_that_are_none_and_states_that_are_none_are_refused(wire):
    report = Report(4, 49, 1.7, -22e-6, -0.5, Amplifier.ON, 0, True)
    payload = wire.sample.pack(report, 0)
    assert wire.sample.unpack(forged(wire.sample, payload, EncoderAlive=14)).alive == 14
    for raw, reason in (({"EncoderAlive": 15}, "alive"), ({"Amplifier": 0}, "state")):
        with pytest.raises(FrameError, match=reason):
            wire.sample.unpack(forged(wire.sample, payload, **raw))
    command = wire.command.pack(Command(3, True, False, 0.1, 7))
    for raw, reason in (
        ({"CommandAlive": 15}, "alive"),
        ({"Enable": 3}, "pattern"),
        ({"Enable": 0}, "pattern"),
        ({"ResetFault": 3}, "pattern"),
    ):
        with pytest.raises(FrameError, match=reason):
            wire.command.unpack(forged(wire.command, command, **raw))
    counting = wire.counting
    for counter in (COUNTER_MODULUS, 2**32 - 1):
        with pytest.raises(FrameError, match="alive"):
            counting.unpack(forged(counting, counting.pack(report, 0), SampleCounter=counter))


def test_a_reading_beyond_the_limits_of_the_dbc_is_not_good():
    payload = FD.sample.pack(Report(4, 49, 1.7, -22e-6, -0.5, Amplifier.ON, 0, True), 0)
    assert FD.sample.unpack(payload).good
    # In two's complement the count below all allowed ones.
    assert not FD.sample.unpack(forged(FD.sample, payload, StageX=2**25)).good
    assert not FD.sample.unpack(forged(FD.sample, payload, PlatformY=2**19)).good


@BUSES
def test_any_two_wrong_bits_are_found(wire):
    payload = wire.sample.pack(Report(4, 49, 1.2345, -67.8e-6, 0.9, Amplifier.ON, 0, True), 0)
    whole, size = int.from_bytes(payload, "little"), len(payload)
    for first in range(8 * size):
        for second in range(first, 8 * size):
            wrong = whole ^ (1 << first) ^ (1 << second if second > first else 0)
            with pytest.raises(FrameError, match="crc"):
                wire.sample.unpack(wrong.to_bytes(size, "little"))


def test_a_stage_trajectory_is_in_the_units_of_the_dbc():
    motion, time = EMULATED.get_message_by_name("StageMotion"), EMULATED.get_message_by_name("StageTime")
    points = forward_and_back(MotionParameters(stroke=1.2, speed=0.25))
    frames = EMULATOR.stage_payloads(points)[:-1]
    for number, point in enumerate(points):
        (first, at), (second, where) = frames[2 * number : 2 * number + 2]
        assert (first, second) == (time.frame_id, motion.frame_id)
        assert time.decode(at) == {"TimeNumber": number, "TimeFromStart": point.time_ns}
        told = motion.decode(where)
        assert told["MotionNumber"] == number
        assert told["Position"] == pytest.approx(point.position, abs=1e-8)
        assert told["Velocity"] == pytest.approx(point.velocity, abs=1e-5)


@given(counts, st.lists(st.floats(allow_nan=False), min_size=6, max_size=6))
def test_a_truth_frame_is_what_the_dbc_says_to_the_last_bit(counter, numbers):
    payload = EMULATOR.truth_payload(counter, Truth(*numbers))
    told = EMULATED.get_message_by_name("Truth").decode(payload, scaling=False)
    assert [*told.values()] == [counter, int.from_bytes(payload[4:8], "little"), *numbers]
    assert EMULATOR.truth_of(payload) == (counter, Truth(*numbers))
    with pytest.raises(FrameError):
        EMULATOR.truth_of(bytes([payload[0] ^ 1]) + payload[1:])


def test_a_cycle_of_the_stage_survives_its_frames():
    waypoints = forward_and_back(MotionParameters())
    receiver = StageReceiver(EMULATOR)
    *_, received = [receiver.add(*frame) for frame in EMULATOR.stage_payloads(waypoints)]
    sent = Trajectory(waypoints)
    assert received.end_ns == sent.end_ns
    for time_ns in range(0, sent.end_ns, 37_000_000):
        assert received.position(time_ns) == pytest.approx(sent.position(time_ns), abs=3e-8)


def test_a_trajectory_that_lacks_a_frame_or_has_a_damaged_one_is_refused():
    frames = EMULATOR.stage_payloads(forward_and_back(MotionParameters()))
    damaged = [(frames[0][0], frames[0][1][:-1] + b"\1"), *frames[1:]]
    for received in (frames[1:], damaged):
        receiver = StageReceiver(EMULATOR)
        with pytest.raises(HardwareError, match="refused"):
            for frame in received:
                receiver.add(*frame)
