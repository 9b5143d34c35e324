"""What the receiver makes of single frames: what it refuses and why, and what it tells of those that it takes."""

import math

import numpy as np
import pytest
from forgery import forged

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import Amplifier, BoardFault, Report
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.hardware.interface import Truth
from straightcomp_ros.model.motion import MotionParameters
from straightcomp_ros.stage.description import StageParameters

START = 10**18
COUNT, AMPERE = 1e-7, 1e-4
# A step of x by 1000 counts a sample, and of y by 100.
STAGE = StageParameters(motion=MotionParameters(speed=0.1, highest_speed=0.2))
Y_SPEED = 0.02
PERIOD = STAGE.period_ns


class Board:
    """A receiver on CAN FD, and samples for it that stand still and come in time if nothing else is said."""

    def __init__(self, **parameters):
        self.receiver = Receiver(CanParameters(fd=True, sample_memory=10_000, y_speed=Y_SPEED, **parameters), STAGE)
        self.number = 0

    def sample(self, x=0, y=0, amplifier=Amplifier.ON, fault=0, good=True, current=0, late_ns=0, lost=0):
        """The next sample after ``lost`` ones, in counts; returns what was delivered of it, or None."""
        self.number += lost
        report = Report(self.number % 15, self.number, x * COUNT, y * COUNT, current * AMPERE, amplifier, fault, good)
        delivered = len(self.receiver.samples)
        frames = self.receiver.wire.sample
        self.hear(frames.identifier, frames.pack(report, 0), late_ns)
        self.number += 1
        return self.receiver.samples[-1] if len(self.receiver.samples) > delivered else None

    def hear(self, identifier, payload, late_ns=0):
        self.receiver.receive(identifier, payload, START + self.number * PERIOD + late_ns)

    def settled(self):
        for _ in range(BLOCK):
            self.sample()
        assert self.receiver.clock.settled and not self.receiver.error_counter
        return self

    def refused(self):
        return {reason: count for reason, count in self.receiver.counts.items() if count}


@pytest.fixture
def board():
    return Board().settled()


@pytest.mark.parametrize("lost", [0, 1, 4])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("name", "step"), [("x", 1000), ("y", 100)])
def test_a_step_is_as_wide_as_the_speed_allows_and_two_counts(board, name, step, sign, lost):
    largest = 2 + step * (lost + 1)
    index, sample, _ = board.sample(lost=lost, **{name: sign * largest})
    assert index == BLOCK + lost and getattr(sample, name) == pytest.approx(sign * largest * COUNT)
    assert board.sample(lost=lost, **{name: sign * (2 * largest + 1)}) is None
    assert board.refused() == {"implausible": 1}


def test_a_sample_is_in_metres_and_ampere_at_the_time_of_its_number(board):
    index, sample, truth = board.sample(x=900, y=-90, current=-1234)
    assert (index, truth) == (BLOCK, None)
    assert sample == (
        START + BLOCK * PERIOD,
        pytest.approx(900 * COUNT),
        pytest.approx(-90 * COUNT),
        pytest.approx(-1234 * AMPERE),
    )
    assert board.receiver.newest_ns == START + BLOCK * PERIOD


def test_a_frame_of_no_state_strikes_and_a_state_with_a_fault_is_told(board):
    frames = board.receiver.wire.sample
    payload = frames.pack(Report(8, 128, 0.0, 0.0, 0.0, Amplifier.OFF, 0, True), 0)
    board.hear(frames.identifier, forged(frames, payload, Amplifier=0))
    assert board.refused() == {"state": 1} and board.receiver.error_counter == 4
    board.sample(amplifier=Amplifier.FAULT, fault=BoardFault.SUPPLY)
    assert board.receiver.amplifier is Amplifier.FAULT and board.receiver.board_fault == BoardFault.SUPPLY
    assert math.isnan(board.receiver.samples[-1][1].current)


def test_readings_that_the_board_says_are_bad_are_counted_and_not_delivered(board):
    received = board.receiver.received
    assert board.sample(good=False) is None
    assert board.refused() == {"encoders": 1} and board.receiver.received == received + 1
    # It was a good frame all the same: its number counts.
    assert board.sample()[0] == BLOCK + 1 and board.receiver.sequence.lost == 0


def test_a_bad_frame_adds_four_strikes_a_good_one_takes_one_off_and_the_limit_begins_anew():
    board = Board(strike_limit=11).settled()
    bad = board.receiver.wire.sample.identifier, bytes(16)
    board.hear(*bad)
    board.hear(*bad)
    assert board.receiver.error_counter == 8 and board.refused() == {"crc": 2}
    board.sample()
    board.sample()
    assert (board.receiver.error_counter, board.receiver.error_limit_hits) == (6, 0)
    board.hear(*bad)
    assert (board.receiver.error_counter, board.receiver.error_limit_hits) == (10, 0)
    board.hear(*bad)
    assert (board.receiver.error_counter, board.receiver.error_limit_hits) == (0, 1)
    assert board.receiver.amplifier is None and not board.receiver.clock.settled
    for _ in range(20):
        board.sample()
    assert board.receiver.error_counter == 0


def test_a_sample_that_is_older_than_the_timeout_when_it_comes_is_stale_and_delivered():
    board = Board(sample_timeout=0.004).settled()
    assert board.sample(late_ns=4_000_000) and board.receiver.stale == 0
    assert board.sample(late_ns=4_001_000) and board.receiver.stale == 1


def test_a_frame_of_another_board_is_foreign_and_no_strike(board):
    board.hear(0x7E5, b"\1\2")
    assert board.refused() == {"foreign": 1} and board.receiver.error_counter == 0


def test_errors_that_the_interface_reports_are_counted_by_their_classes(board):
    for classes, details in (
        (0x40, bytes(8)),
        (0x04, bytes([0, 0x10])),
        (0x04, bytes([0, 0x20])),
        (0x04, bytes([0, 0x04])),
        (0x04, b"\x30"),
        (0x02, bytes([0, 0x30])),
    ):
        board.receiver.receive_error_frame(classes, details)
    assert board.refused() == {"error_frames": 6, "bus_off": 1, "error_passive": 2}
    assert board.receiver.error_counter == 0


def test_a_heartbeat_tells_the_boards_state_and_its_time(board):
    heartbeat = board.receiver.wire.heartbeat.identifier
    # The highest bit is CiA 301's toggle bit of node guarding.
    operational = board.receiver.wire.meaning.heartbeat.operational_value
    for payload in (bytes([operational]), bytes([operational | 0x80])):
        board.hear(heartbeat, payload, late_ns=7)
        assert board.receiver.node_state == operational
        assert board.receiver.heartbeat_ns == START + board.number * PERIOD + 7
    assert board.receiver.boot_ups == 0 and board.receiver.amplifier is Amplifier.ON
    board.hear(heartbeat, b"\5\5")
    assert board.refused() == {"length": 1} and board.receiver.error_counter == 4


def test_the_truth_of_an_emulated_board_belongs_to_the_sample_of_its_number():
    truth = Truth(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    plain, told = Board().settled(), Board(simulated_stage=True).settled()
    emulator = EmulatorFrames(1, told.receiver.wire)
    identifier, truth_payload = emulator.truth_id, emulator.truth_payload
    assert identifier not in plain.receiver.identifiers
    told.hear(identifier, truth_payload(told.number, truth))
    assert told.sample()[2] == truth
    told.hear(identifier, truth_payload(told.number + 1, truth))
    assert told.sample()[2] is None
    assert told.sample()[2] == truth
    payload = truth_payload(told.number, truth)
    for damaged in (payload[:-1], bytes([payload[0] ^ 1]) + payload[1:]):
        told.hear(identifier, damaged)
    assert told.sample()[2] is None
    # Nobody acts on it: it is counted, and no strike.
    assert told.refused() == {"truth": 2} and told.receiver.error_counter == 0


def test_a_classic_bus_has_the_coil_current_in_a_frame_of_its_own_and_no_truth():
    receiver = Receiver(CanParameters(fd=False, simulated_stage=True), STAGE)
    assert receiver.identifiers == [0x181, 0x281, 0x701]
    fd = Receiver(CanParameters(fd=True, simulated_stage=True), STAGE)
    assert fd.identifiers == [0x381, 0x701, 0x581]


def test_stamps_never_run_backwards_when_the_clock_is_set_anew(board):
    newest = board.sample()[1].stamp_ns
    board.receiver.restart()
    # The host's clock seems to have gone back by ten periods: what would come before is not delivered.
    board.number -= 10
    stamps = [sample[1].stamp_ns for sample in (board.sample() for _ in range(2 * BLOCK)) if sample]
    assert stamps and stamps[0] > newest and set(np.diff(stamps)) == {PERIOD}
