"""Frames against implementations that are not ours: cantools for the bits, crccheck and AUTOSAR's examples for the CRC.

Random layouts are drawn by hypothesis; the package's own frames are compared with config/straightcomp.dbc."""

import contextlib
import itertools
import math
import random
import re
import struct
from collections import Counter
from unittest.mock import Mock

import cantools
import crccheck.crc
import pytest
from cantools import autosar
from cantools.database.can import Message, Signal
from cantools.database.conversion import IdentityConversion, LinearConversion
from drawn_dbc import drawn_message
from forgery import damaged, forged
from hypothesis import example, given
from hypothesis import strategies as st

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.dbc_file import DbcError, in_page, limits, pages
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import (
    BoardFault,
    Command,
    Crc,
    FrameError,
    Frames,
    Report,
    data_ids,
)
from straightcomp_ros.hardware.interface import HardwareError, State, Truth
from straightcomp_ros.model.motion import MotionParameters, Waypoint, forward_and_back
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.parameters.share import share_path

DBC = cantools.database.load_file(share_path("config/straightcomp.dbc"))
EMULATED = cantools.database.load_file(share_path("config/emulator.dbc"))
CLASSIC, FD = (CanParameters(fd=fd).make_wire() for fd in (False, True))
EMULATOR = EmulatorFrames(FD)
BUSES = pytest.mark.parametrize("wire", [CLASSIC, FD], ids=["classic", "fd"])
COUNTER_MODULUS = 15 * 2**28


def multiples(bits, step):
    """Numbers of ``step`` that a signed signal of so many bits has."""
    return st.integers(-(2 ** (bits - 1)) + 1, 2 ** (bits - 1) - 1).map(lambda count: count * step)


wires = st.sampled_from([CLASSIC, FD])
counts = st.one_of(st.sampled_from([0, COUNTER_MODULUS - 1]), st.integers(0, COUNTER_MODULUS - 1))
reports = st.builds(
    Report,
    *(st.integers(0, 14), counts, multiples(26, 1e-7), multiples(20, 1e-7), multiples(16, 1e-4)),
    *(st.sampled_from(State), st.sampled_from(BoardFault).map(int), st.booleans(), st.booleans()),
)
commands = st.builds(Command, st.integers(0, 14), st.booleans(), st.booleans(), multiples(16, 1e-4), counts)
REPORT = Report(4, 49, 1.7, -22e-6, -0.5, State.ON, 0, True, True)
COMMAND = Command(3, True, False, 0.1, 7)
FIELDS = {
    **dict.fromkeys(("EncoderAlive", "CoilCurrentAlive", "CommandAlive"), "alive"),
    **dict.fromkeys(("MeasuredCurrent", "ControlCurrent"), "current"),
    **{"SampleCounter": "counter", "StageX": "x", "PlatformY": "y", "Amplifier": "amplifier", "BoardFault": "fault"},
    **{"EncodersValid": "good", "Referenced": "referenced"},
    **{"Enable": "enable", "ResetFault": "reset", "EchoedCounter": "echo"},
}
"""By the signal's name the field of a report or command."""
RAW = {State.OFF: 1, State.ON: 2, State.FAULT: 3}


@given(reports | commands, wires)
def test_what_board_and_host_say_is_what_the_dbc_says_and_comes_back(said, wire):
    if isinstance(said, Command):
        said = said._replace(echo=said.echo % wire.echo_modulus)
    seen = set()
    for frames in wire.reports.values() if isinstance(said, Report) else wire.commands:
        payload = frames.pack(said)
        back, decoded = frames.unpack(payload), DBC.get_message_by_name(frames.name).decode(payload, False)
        for name, field in ((name, FIELDS[name]) for name in decoded if name in FIELDS):
            value = getattr(said, field)
            assert getattr(back, field) == value
            value = 1 + value if field in ("enable", "reset") else RAW.get(value, value)
            assert decoded[name] == pytest.approx(float(value), rel=1e-12)
            seen.add(field)
    assert seen == set(said._fields)


@BUSES
def test_what_is_not_as_the_dbc_says_is_refused_by_length_identifier_count_state_or_pattern(wire):
    other = CanParameters(fd=wire is FD, node=2).make_wire()
    for frames, said, twin in ((wire.sample, REPORT, other.sample), (wire.command, COMMAND, other.command)):
        payload = frames.pack(said)
        assert twin.identifier == frames.identifier + 1
        for reader, wrong, reason in (
            *((frames, wrong, "length") for wrong in (payload[:-1], payload + b"\0", b"")),
            (twin, payload, "crc"),
        ):
            with pytest.raises(FrameError, match=reason):
                reader.unpack(wrong)
    assert wire.sample.unpack(forged(wire.sample, wire.sample.pack(REPORT), EncoderAlive=14)).alive == 14
    for frames, said, signal, raws, reason in (
        *((wire.sample, REPORT, "EncoderAlive", [15], "alive"), (wire.sample, REPORT, "Amplifier", [0], "state")),
        *((wire.command, COMMAND, "CommandAlive", [15], "alive"), (wire.command, COMMAND, "Enable", [0, 3], "pattern")),
        (wire.command, COMMAND, "ResetFault", [3], "pattern"),
        (wire.counting, REPORT, "SampleCounter", [COUNTER_MODULUS, 2**32 - 1], "alive"),
    ):
        for raw in raws:
            with pytest.raises(FrameError, match=reason):
                frames.unpack(forged(frames, frames.pack(said), **{signal: raw}))


@pytest.mark.parametrize("is_signed", [True, False])
@pytest.mark.parametrize("scale", [0.5, -0.25])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_beyond_the_limits_of_the_dbc_a_reading_is_not_good_and_a_current_no_number(axis, is_signed, scale):
    line = LinearConversion(scale, 3, False)
    fields = {
        field: Signal(field, start, 6, is_signed=is_signed, conversion=line, minimum=-1, maximum=7)
        for field, start in ((axis, 1), ("current", 9))
    }
    described = Message(1, "One", 2, [*fields.values()])
    frames = Frames(described, 1, fields, dict.fromkeys(fields, 1.0), None, Report)
    for raw in range(-32, 32) if is_signed else range(64):
        value = raw * scale + 3
        found = frames.unpack(described.encode(dict.fromkeys(fields, raw), scaling=False, strict=False))
        assert getattr(found, axis) == value and found.good == (-1 <= value <= 7)
        assert found.current == value if found.good else math.isnan(found.current)


@pytest.mark.parametrize("raw", [math.nan, math.inf, -math.inf, 1.7e308])
def test_a_reading_that_is_no_finite_number_in_metres_is_not_good(raw):
    signal = Signal("x", 0, 64, conversion=LinearConversion(2.0, 0.0, True))
    frames = Frames(Message(1, "One", 8, [signal]), 1, {"x": signal}, {"x": 1.0}, None, Report)
    assert not frames.unpack(struct.pack("<d", raw)).good and math.isfinite(frames.spans["x"][1])


@BUSES
@pytest.mark.parametrize(("axis", "bits"), [("StageX", 26), ("PlatformY", 20)])
def test_the_shipped_file_does_not_allow_the_lowest_raw_value_of_a_reading(wire, axis, bits):
    found = wire.sample.unpack(forged(wire.sample, wire.sample.pack(REPORT), **{axis: -(2 ** (bits - 1))}))
    assert wire.sample.unpack(wire.sample.pack(REPORT)).good and not found.good


def test_the_faults_of_a_board_are_those_of_the_file():
    for name in ("Encoder", "EncoderFd"):
        choices = DBC.get_message_by_name(name).get_signal_by_name("BoardFault").choices
        named = {raw: str(words).replace(" ", "_").upper() for raw, words in choices.items()}
        assert {int(fault): fault.name for fault in BoardFault} == named


@BUSES
def test_any_two_wrong_bits_are_found(wire):
    payload = wire.sample.pack(Report(4, 49, 1.2345, -67.8e-6, 0.9, State.ON, 0, True, True), 0)
    whole, size = int.from_bytes(payload, "little"), len(payload)
    for first in range(8 * size):
        for second in range(first, 8 * size):
            wrong = whole ^ (1 << first) ^ (1 << second if second > first else 0)
            with pytest.raises(FrameError, match="crc"):
                wire.sample.unpack(wrong.to_bytes(size, "little"))


@example(0, [-0.0, 0.0, math.inf, -math.inf, 1.0, -5e-324])
@given(counts, st.lists(st.floats(allow_nan=False), min_size=6, max_size=6))
def test_a_truth_frame_is_what_the_dbc_says_to_the_last_bit(counter, numbers):
    payload = EMULATOR.truth_payload(counter, Truth(*numbers))
    decoded_values = EMULATED.get_message_by_name("Truth").decode(payload, scaling=False)
    assert [*decoded_values.values()] == [counter, int.from_bytes(payload[4:8], "little"), *numbers]
    assert EMULATOR.truth_of(payload) == (counter, Truth(*numbers))
    assert EMULATOR.truth_payload(*EMULATOR.truth_of(payload)) == payload
    with pytest.raises(FrameError):
        EMULATOR.truth_of(damaged(payload, 0))


@pytest.mark.parametrize("examples", [500, pytest.param(2000, marks=pytest.mark.nightly)])
def test_random_layouts_are_packed_and_unpacked_as_cantools_does(examples):
    compared = Counter()
    for seed in range(examples):
        (message,) = cantools.database.load_string(drawn_message(seed), "dbc", strict=True).messages
        for page in pages(message, message.signals):
            shown = [one for one in message.signals if in_page(message, one, page) and one.name not in page]
            if shown:
                compare(message, shown, page, random.Random(seed))
                compared.update(("big_endian",) * any(one.byte_order == "big_endian" for one in shown))
                compared.update(("signed",) * any(one.is_signed for one in shown))
                compared.update(("float",) * any(one.is_float for one in shown))
                compared.update(("multiplexed",) * bool(page))
    assert len(compared) == 4 and min(compared.values()) >= 0.15 * examples, compared


def compare(message, shown, page, chance):
    by_name = {one.name: one for one in shown}
    raw, scaled = (Frames(message, 1, by_name, factors) for factors in ({}, dict.fromkeys(by_name, 1.0)))
    values = {one.name: raw_value(one, chance) for one in shown}
    expected = message.encode({**values, **page}, scaling=False, strict=False)
    assert raw.pack(tuple(values.values())) == expected
    decoded = message.decode(expected, scaling=False, decode_choices=False)
    assert list(raw.unpack(expected)) == [decoded[name] for name in by_name]
    physical, found = message.decode(expected, decode_choices=False), scaled.unpack(expected)
    assert list(found) == pytest.approx([physical[name] for name in by_name], rel=1e-12, abs=1e-300)
    # A number that has no more digits than a double comes back to the same bits.
    if all(one.length <= 48 and not one.is_float for one in shown):
        assert scaled.pack(found) == expected


def raw_value(signal, chance):
    """A raw value of a signal, now and then one of its ends."""
    least, largest = limits(signal)
    if chance.random() < 0.2:
        return chance.choice([least, largest, 0])
    if signal.is_float:
        # As many digits as the float has.
        return struct.unpack("f", struct.pack("f", chance.gauss(0.0, 1e3)))[0]
    return chance.randint(least, largest)


SMALL_DBC = """VERSION ""
NS_ :
BS_:
BU_: A B
BO_ 1 One: 8 A
 SG_ Small : 0|12@1- (0.5,10) [-5|20] "m" B
 SG_ Free : 12|12@1- (0.5,10) [0|0] "m" B
 SG_ Real : 32|32@1- (1,0) [-2|2] "m" B
SIG_VALTYPE_ 1 Real : 1;
"""


IDS_OF_2 = list(range(0x40, 0x50))


@pytest.mark.parametrize(
    ("signal", "allowed", "refused", "words"),
    [
        (
            "Small",
            (-5.2, -5.0, 20.0, 20.2),
            (-5.25, 20.25, math.nan),
            "signal 'Small' of message 'One'; allowed: -5 to 20 m",
        ),
        ("Real", (-2.0, 2.0), (2.5, math.nan, math.inf), "signal 'Real' of message 'One'; allowed: -2 to 2 m"),
        # Rounded, half a step more would be the least raw value.
        ("Free", (-1014.0, 1033.5), (-1014.25, 1033.75, math.nan), "allowed: -1014 to 1033.5 m"),
    ],
)
def test_a_value_beyond_the_limits_of_file_or_bits_is_refused_by_name(signal, allowed, refused, words):
    (one,) = cantools.database.load_string(SMALL_DBC, "dbc").messages
    frames = Frames(one, 1, {"x": one.get_signal_by_name(signal)}, {"x": 1.0})
    for value in allowed:
        assert frames.unpack(frames.pack((value,))) == pytest.approx((value,), abs=0.25)
    for value in refused:
        with pytest.raises(ValueError, match=rf"x of {value} m does not fit .*{re.escape(words)}"):
            frames.pack((value,))


def message(order="little_endian", **places):
    """A message of 8 bytes with these unsigned signals: first bit and number of bits."""
    return Message(1, "One", 8, [Signal(name, *place, order) for name, place in places.items()])


FIRST = message(Crc=(0, 8), Alive=(8, 4), Value=(16, 48))
WIDE = message(Crc=(0, 16), Alive=(16, 8), Value=(24, 40))
LAST = message("big_endian", Value=(7, 48), Alive=(51, 4), Crc=(63, 8))


def protected(described, profile, ids):
    """Frames with a message's alive counter and value under a profile."""
    crc, alive, value = map(described.get_signal_by_name, ("Crc", "Alive", "Value"))
    sealed = Crc(described, crc, alive, profile, ids)
    return Frames(described, 1, {"alive": alive, "value": value}, crc=sealed)


def profile_1(payload, place, data_id):
    return crccheck.crc.Crc8GsmA.calc(data_id.to_bytes(2, "little") + payload[:place] + payload[place + 1 :])


@given(st.integers(0, 14), st.integers(0, 2**40 - 1), st.integers(0, 0xFFFF))
def test_crcs_are_those_of_other_implementations(alive, value, data_id):
    for described, profile, ids, expected in (
        (FIRST, "e2e_1", [data_id], lambda payload: payload[0] == profile_1(payload, 0, data_id)),
        (LAST, "e2e_1", [data_id], lambda payload: payload[7] == profile_1(payload, 7, data_id)),
        (FIRST, "e2e_2", IDS_OF_2, lambda payload: autosar.check_profile2_crc(payload, IDS_OF_2[alive])),
        (WIDE, "e2e_5", [data_id], lambda payload: autosar.check_profile5_crc(payload, data_id)),
        (FIRST, "j1850", [], lambda payload: payload[0] == crccheck.crc.Crc8SaeJ1850.calc(payload[1:])),
        (LAST, "j1850", [], lambda payload: payload[7] == crccheck.crc.Crc8SaeJ1850.calc(payload[:7])),
    ):
        frames = protected(described, profile, ids)
        payload = frames.pack((alive, value))
        assert expected(payload), profile
        assert frames.unpack(payload) == (alive, value)
        for byte in range(len(payload)):
            with pytest.raises(FrameError, match="crc"):
                frames.unpack(damaged(payload, byte))


def test_profile_1_gives_the_examples_of_autosar_for_data_id_0x123_and_alone_reserves_the_count_15():
    frames = protected(FIRST, "e2e_1", [0x123])
    assert [frames.pack((alive, 0))[0] for alive in (0, 1)] == [0xCC, 0x91] and frames.alive_modulus == 15
    assert protected(FIRST, "e2e_2", IDS_OF_2).alive_modulus == protected(FIRST, "j1850", []).alive_modulus == 16


@pytest.mark.parametrize("order", ["little_endian", "big_endian"])
@pytest.mark.parametrize("profile", ["e2e_1", "e2e_5"])
def test_a_crc_fills_whole_bytes_and_has_no_sign(profile, order):
    bits, first = 8 if profile == "e2e_1" else 16, 8 if order == "little_endian" else 15
    for start, length, how, allowed in (
        *((start, bits, {}, start == first) for start in range(8, 16)),
        *((first, length, {}, False) for length in (bits - 8, bits - 1, bits + 8)),
        (first, bits, {"is_signed": True}, False),
        (first, bits, {"conversion": IdentityConversion(is_float=True)}, False),
    ):
        signal = Signal("Crc", start, length, order, **how)
        with contextlib.nullcontext() if allowed else pytest.raises(DbcError, match=f"{bits} bits, unsigned, whole"):
            assert Crc(Message(1, "One", 8, []), signal, None, profile, [7]).begin == 1


def test_profile_2_needs_a_count_of_four_bits_and_the_place_of_its_bits():
    for start, length, allowed in ((8, 4, True), (12, 4, True), (8, 3, False), (8, 5, False)):
        described = message(Crc=(0, 8), Alive=(start, length), Value=(16, 48))
        with contextlib.nullcontext() if allowed else pytest.raises(DbcError, match="'alive' of 4 bits"):
            payload = protected(described, "e2e_2", IDS_OF_2).pack((5, 2**48 - 1))
            assert payload[0] == crccheck.crc.Crc8Autosar.calc(payload[1:] + bytes([IDS_OF_2[5]]))


def test_data_ids_are_as_many_and_as_large_as_the_profile_has_or_the_can_identifier():
    assert data_ids("", "e2e_1", 0x381) == [0x381] and data_ids("", "e2e_5", 0x98FF0201) == [0x0201]
    assert data_ids("0x123", "e2e_1", 1) == [0x123] and data_ids("", "j1850", 1) == []
    with pytest.raises(DbcError, match="'7' is not allowed with profile j1850, which has no data id"):
        data_ids("7", "j1850", 1)
    for profile, most, others in (("e2e_1", 0xFFFF, ""), ("e2e_5", 0xFFFF, ""), ("e2e_2", 0xFF, " 0" * 15)):
        assert data_ids(f"{most}{others}", profile, 1)[0] == most and data_ids(f"0{others}", profile, 1)[0] == 0
        for wrong in (f"{most + 1}{others}", f"-1{others}", f"{most}{others} 0", others, "", f"one{others}"):
            if wrong or profile == "e2e_2":
                with pytest.raises(DbcError, match=rf"allowed with profile {profile}; allowed: .* of 0 to {most:#x}"):
                    data_ids(wrong, profile, 1)


STATES = [triple for triple in itertools.product(range(-1, 4), repeat=3) if triple[1] >= 0]
STATES = [triple for triple in STATES if len({raw for raw in triple if raw >= 0}) == sum(raw >= 0 for raw in triple)]


@pytest.mark.parametrize(("off", "on", "fault"), STATES)
def test_a_state_is_that_whose_raw_value_it_has_or_else_off_or_what_the_fault_code_says(off, on, fault):
    described = message(Amplifier=(3, 2), Fault=(8, 2), Good=(12, 2))
    fields = {name.lower(): described.get_signal_by_name(name) for name in ("Amplifier", "Fault", "Good")}
    said = dict(zip(State, (off, on, fault), strict=True))
    fields["good"].is_signed = True
    described.refresh()
    values = {"amplifier": said, "good": {False: -2, True: -1}}
    frames = Frames(described, 1, fields, {}, values, Report, no_fault=2)
    meanings = {raw: state for state, raw in said.items() if raw >= 0}
    for raw, code, good in itertools.product(range(4), range(4), range(-2, 2)):
        expected = State.FAULT if fault < 0 and code != 2 else meanings.get(raw, State.OFF if off < 0 else None)
        payload = described.encode({"Amplifier": raw, "Fault": code, "Good": good})
        if expected is None:
            with pytest.raises(FrameError, match="state"):
                frames.unpack(payload)
        else:
            report = frames.unpack(payload)
            assert (report.amplifier, report.fault, report.good) == (expected, code, good == -1)
            assert frames.unpack(frames.pack(report)) == report
            sent = described.decode(frames.pack(report))["Amplifier"]
            unmarked = State.OFF if expected is State.FAULT and fault < 0 else expected
            assert sent == said[unmarked] or said[unmarked] < 0
            assert described.decode(frames.pack(report))["Good"] == (-1 if good == -1 else -2)


@pytest.mark.parametrize("is_signed", [True, False])
@pytest.mark.parametrize("scale", [0.5, -0.25])
def test_an_x_that_wraps_is_the_one_of_its_turns_that_the_signal_has(is_signed, scale):
    signal = Signal("X", 3, 6, is_signed=is_signed, conversion=LinearConversion(scale, 3, False))
    frames = Frames(Message(1, "One", 8, [signal]), 1, {"x": signal}, {"x": 1e-3}, wraps=True)
    raws = range(-32, 32) if is_signed else range(64)
    held = [(raw * scale + 3) * 1e-3 for raw in raws]
    assert frames.x_modulus == pytest.approx(64e-3 * abs(scale)) and frames.turn == pytest.approx((held[0], held[-1]))
    assert frames.spans["x"] == pytest.approx((min(held), max(held)))
    for turns in (-3, -1, 0, 2):
        for x in held:
            (found,) = frames.unpack(frames.pack((x + turns * frames.x_modulus,)))
            assert found == pytest.approx(x, abs=1e-12)


def emulated():
    """A machine behind an emulated board, and what takes frames for it and says why they were refused."""
    machine, emulator = Mock(), EmulatorFrames(FD)

    def received(*frames):
        for identifier, payload in frames:
            emulator.obey(identifier, payload, machine, 0)
        return emulator.refused

    return machine, received


def test_a_trajectory_is_what_the_dbc_says_and_comes_back_to_ten_nanometres_and_ten_micrometres_per_second():
    motion, time = EMULATED.get_message_by_name("StageMotion"), EMULATED.get_message_by_name("StageTime")
    far = [Waypoint(2**55 - 1, -0.123456785, -0.12346), Waypoint(2**55, 1.76, 0.0)]
    points = [*forward_and_back(MotionParameters(stroke=1.2, speed=0.25)), *far]
    (machine, received), frames = emulated(), EMULATOR.stage_payloads(points)
    assert [identifier for identifier, _ in frames] == [0x401, 0x481] * len(points) + [0x501]
    for number, point in enumerate(points):
        (_, at), (_, where) = frames[2 * number : 2 * number + 2]
        assert time.decode(at) == {"TimeNumber": number, "TimeFromStart": point.time_ns}
        said = {"MotionNumber": number, "Position": point.position, "Velocity": point.velocity}
        assert motion.decode(where) == pytest.approx(said, abs=0.51e-5)
        assert motion.decode(where)["Position"] == pytest.approx(point.position, abs=0.51e-8)
    assert not received(*frames)
    moved = machine.move.call_args.args[0].waypoints
    assert [point.time_ns for point in moved] == [point.time_ns for point in points]
    for found, point in zip(moved, points, strict=True):
        assert found.position == pytest.approx(point.position, abs=0.51e-8)
        assert found.velocity == pytest.approx(point.velocity, abs=0.51e-5)
    # What was gathered is used once.
    assert "missing" in received(frames[-1]) and machine.move.call_count == 1


@pytest.mark.parametrize("pace", [Pace(), Pace(0.3, hold=True), Pace(0.0, end=True), Pace(0.1234, True, True)])
def test_a_pace_is_what_the_dbc_says_reaches_the_machine_whole_and_a_damaged_frame_changes_nothing(pace):
    identifier, payload = EMULATOR.pace_payload(pace)
    said = EMULATED.get_message_by_name("StagePace").decode(payload)
    assert identifier == 0x601 and said.pop("PaceCrc")
    assert [said[name] for name in ("Override", "Hold", "End")] == pytest.approx([*map(float, pace)])
    machine, received = emulated()
    for wrong in (payload + b"\0", *(damaged(payload, byte) for byte in range(8))):
        assert "'StagePace' is damaged" in received((identifier, wrong)) and not machine.pace.called
    received((identifier, payload))
    ((found,),) = (call.args for call in machine.pace.call_args_list)
    assert [*map(float, found)] == pytest.approx([*map(float, pace)])


def test_a_stage_may_have_255_points_and_each_must_fit():
    points = [Waypoint(k, 0.0, 0.0) for k in range(256)]
    assert len(EMULATOR.stage_payloads(points[:255])) == 511
    with pytest.raises(HardwareError, match="256 points; allowed over CAN: <= 255"):
        EMULATOR.stage_payloads(points)
    for point in (Waypoint(0, 21.5, 0.0), Waypoint(0, 0.0, 84.0), Waypoint(2**56, 0.0, 0.0)):
        with pytest.raises(HardwareError, match="does not fit"):
            EMULATOR.stage_payloads([point])


def test_a_trajectory_of_which_a_frame_is_damaged_or_another_is_refused():
    frames = EMULATOR.stage_payloads([Waypoint(0, 0.0, 0.0), Waypoint(9, 1.0, 0.0)])
    for place, (identifier, payload) in enumerate(frames):
        for wrong in ((identifier + 1, payload), (identifier, payload + b"\0"), (identifier, damaged(payload, 4))):
            machine, received = emulated()
            refused = received(*frames[:place], wrong, *frames[place + 1 :])
            assert not machine.move.called and bool(refused) == (wrong != (0x502, payload))
