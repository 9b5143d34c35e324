"""Small parts of the CAN side, each by itself: packets, messages, the stage's frames, and what the trials count."""

import itertools
import struct

import pytest

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames, StageReceiver
from straightcomp_ros.hardware.can.hub import (
    ERROR,
    EXTENDED,
    FD_FRAME,
    LONGEST,
    REMOTE,
    Faults,
    Frame,
    from_packet,
    priority,
    to_packet,
)
from straightcomp_ros.hardware.can.hub_bus import frame_of, message_of
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.model.motion import Waypoint
from straightcomp_ros.parameters.declaration import ParameterError
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from trials.bench.can_fault_trial import position, run_trial
from trials.bench.can_servo_trial import _START_NS, _TRANSIT_NS, _Trial

PERIOD = 500_000
EMULATOR = EmulatorFrames(1, CanParameters().make_wire())


def test_a_frame_comes_out_of_its_packet_and_out_of_its_message_as_it_was():
    for flags, size in ((0, 8), (EXTENDED, 0), (FD_FRAME, 64), (REMOTE, 0), (ERROR, 8), (EXTENDED | FD_FRAME, 12)):
        frame = Frame(1_700_000_000_000_001_024, 0x181, flags, bytes(range(size)))
        packet = to_packet(frame)
        assert from_packet(packet) == frame and len(packet) == 13 + size <= LONGEST
        message = message_of(frame)
        # python-can keeps the time as a float of seconds, which has a quarter of a microsecond at this date.
        assert frame_of(message)._replace(stamp_ns=frame.stamp_ns) == frame
        assert abs(frame_of(message).stamp_ns - frame.stamp_ns) < 500
        assert message.timestamp == pytest.approx(1.7e9)


def test_a_standard_frame_wins_over_an_extended_one_with_the_same_first_bits():
    def order(identifier, flags=0):
        return priority(to_packet(Frame(0, identifier, flags, b"")))

    extended = [0x181 << 18, 0x181 << 18 | 1, 0x181 << 18 | 0x3FFFF]
    ranks = [order(0x180), order(0x181), *(order(identifier, EXTENDED) for identifier in extended), order(0x182)]
    assert ranks == sorted(ranks) and len(set(ranks)) == len(ranks)


def test_a_waypoint_is_kept_to_ten_nanometres_and_ten_micrometres_per_second():
    points = [Waypoint(0, -0.123456785, 0.0), Waypoint(10**9, 1.76, -0.12346), Waypoint(2**55, 1.76, 0.0)]
    frames = EMULATOR.stage_payloads(points)
    assert [identifier for identifier, _ in frames] == [0x401, 0x481] * 3 + [0x501]
    *gathering, received = [StageReceiver(EMULATOR), *frames]
    receiver, *others = gathering
    assert all(receiver.add(*frame) is None for frame in others)
    found = receiver.add(*received).waypoints
    assert [point.time_ns for point in found] == [point.time_ns for point in points]
    assert [point.position for point in found] == pytest.approx([point.position for point in points], abs=0.51e-8)
    assert [point.velocity for point in found] == pytest.approx([point.velocity for point in points], abs=0.51e-5)
    # A stage's velocity travels in units of 10 µm/s.
    assert struct.unpack("<i", frames[3][1][5:] + b"\xff")[0] == -12346
    # What was gathered is used once.
    with pytest.raises(HardwareError, match="missing"):
        receiver.add(*received)


def test_a_stage_may_have_255_points_and_each_must_fit():
    points = [Waypoint(k, 0.0, 0.0) for k in range(256)]
    assert len(EMULATOR.stage_payloads(points[:255])) == 511
    with pytest.raises(HardwareError, match="256 points; allowed over CAN: <= 255"):
        EMULATOR.stage_payloads(points)
    for point in (Waypoint(0, 21.5, 0.0), Waypoint(0, 0.0, 84.0), Waypoint(2**56, 0.0, 0.0)):
        with pytest.raises(HardwareError, match="does not fit"):
            EMULATOR.stage_payloads([point])


def test_frames_of_another_length_or_identifier_are_none_of_the_stages():
    frames = EMULATOR.stage_payloads([Waypoint(0, 0.0, 0.0), Waypoint(9, 1.0, 0.0)])
    for spoiled in range(4):
        for change in (lambda i, data: (i, data + b"\0"), lambda i, data: (i + 1, data)):
            receiver = StageReceiver(EMULATOR)
            for number, frame in enumerate(frames[:-1]):
                assert receiver.add(*(change(*frame) if number == spoiled else frame)) is None
            with pytest.raises(HardwareError, match="missing"):
                receiver.add(*frames[-1])
    assert StageReceiver(EMULATOR).add(frames[-1][0], frames[-1][1] + b"\0") is None


def test_options_of_an_interface_are_pairs_of_a_name_and_a_value():
    assert CanParameters(options="bustype=x tty=/dev/a=b empty=").further_options() == {
        "bustype": "x",
        "tty": "/dev/a=b",
        "empty": "",
    }
    assert CanParameters().further_options() == {}
    for wrong in ("name", "a-b=1", "=1", "a=1 b"):
        with pytest.raises(ParameterError, match="NAME=VALUE"):
            CanParameters(options=wrong)


def test_the_stage_of_a_trial_goes_to_and_fro_at_its_speed_and_so_does_the_platform():
    places = [position(index) for index in range(0, 40_000)]
    assert all(abs(after[0] - before[0]) <= 1500 for before, after in itertools.pairwise(places))
    assert all(abs(after[1] - before[1]) <= 7 for before, after in itertools.pairwise(places))
    x, y = zip(*places, strict=True)
    assert (min(x), max(x)) == (0, pytest.approx(17_600_000, abs=1500))
    assert (min(y), max(y)) == (pytest.approx(-220, abs=4), pytest.approx(220, abs=4))
    assert position(0) == (0, -220) and position(1) == (1500, -213)


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
def test_a_trial_of_a_good_bus_delivers_every_sample_after_the_first_block(fd):
    trial = run_trial({}, CanParameters(fd=fd), frames=600, first=123)
    assert trial.frames == 600 and trial.injected == {} and trial.unflagged_wrong == 0
    assert trial.delivered == 600 - BLOCK + 1
    assert not any(trial.receiver.counts.values()) and trial.receiver.sequence.lost == 0


def test_a_servo_trial_counts_samples_of_the_wrong_place_number_or_time():
    trial = _Trial({}, load_map(MapParameters(file="config/guide_synthetic.csv")), CanParameters(), 1)
    trial._taken[:] = [(1.0, 2.0), (3.0, 4.0)]
    second = _START_NS + _TRANSIT_NS + PERIOD
    for stamp_ns, place, wrong in (
        (second, (3.0, 4.0), 0),
        (second + _TRANSIT_NS // 2, (3.0, 4.0), 0),
        (second - PERIOD, (1.0, 2.0), 0),
        (second, (3.0, 4.1), 1),
        (second, (1.0, 2.0), 1),
        (second + _TRANSIT_NS, (3.0, 4.0), 1),
        (second + PERIOD, (3.0, 4.0), 1),
        (second - 2 * PERIOD, (3.0, 4.0), 1),
    ):
        trial.wrong = 0
        trial._check(stamp_ns, place)
        assert trial.wrong == wrong, (stamp_ns - second, place)


def test_a_fault_of_rate_one_is_made_every_time_and_of_rate_zero_never():
    frame = Frame(0, 0x181, 0, bytes(8))
    for kind in ("drop", "duplicate", "corrupt", "truncate", "wrong_id"):
        faults = Faults({kind: 1.0})
        arrived = [faults(frame) for _ in range(50)]
        assert faults.injected == {kind: 50} and [frame] not in arrived
        never = Faults({kind: 0.0})
        assert [never(frame) for _ in range(50)] == [[frame]] * 50 and never.injected == {kind: 0}
    # A request has the identifier of the frame, in either of its lengths, and no data.
    for flags in (EXTENDED, FD_FRAME):
        request, own = Faults({"remote": 1.0})(frame._replace(flags=flags))
        assert own.data and request == (0, 0x181, flags & EXTENDED | REMOTE, b"")
    # One or two bits of a corrupt frame are wrong, and both numbers happen.
    faults = Faults({"corrupt": 1.0})
    bits = [bin(int.from_bytes(faults(frame)[0].data, "little")).count("1") for _ in range(200)]
    assert set(bits) == {1, 2}
    # A frame under another identifier differs in one of eleven bits.
    faults = Faults({"wrong_id": 1.0})
    changed = {faults(frame)[0].identifier ^ 0x181 for _ in range(400)}
    assert changed == {1 << bit for bit in range(11)}


def test_two_frames_of_a_kind_are_swapped_and_two_of_different_kinds_are_not():
    first, second = Frame(0, 0x181, 0, b"1"), Frame(1, 0x181, 0, b"2")
    other = Frame(2, 0x281, 0, b"3")
    faults = Faults({"reorder": 1.0})
    assert faults(first) == [] and faults(second) == [second, first] and faults.injected == {"reorder": 1}
    assert faults(first) == [] and faults(other) == [first] and faults.injected == {"reorder": 1}
