"""The receiver: each fault of a bad bus is counted, no wrong sample is used, and what it makes of single frames."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from can_boards import BARE, FOREIGN, PERIOD, START
from forgery import damaged, forged

from straightcomp_ros.hardware.can.can_parameters import CanParameters, shipped_wire
from straightcomp_ros.hardware.can.emulator_frames import EmulatorFrames
from straightcomp_ros.hardware.can.frames import Report
from straightcomp_ros.hardware.can.hub import ERROR, Frame
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.hardware.interface import State, Truth
from straightcomp_ros.model.converters import EncoderParameters
from straightcomp_ros.model.motion import MotionParameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.safety.watch import ZeroWatch
from straightcomp_ros.stage.description import StageParameters
from trials.can import COUNTED, run_trial

BUSES = pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])


@BUSES
@pytest.mark.parametrize("kind", COUNTED)
def test_each_fault_is_found_as_often_as_it_was_made_and_no_wrong_sample_is_used(kind, fd):
    # Long enough that the stage turns round in it.
    trial = run_trial(kind, CanParameters(fd=fd), frames=(frames := 12_500))
    assert trial.injected > 200
    assert trial.detected == trial.injected
    assert trial.unflagged_wrong == 0
    missing = 0 if kind in ("duplicate", "error_frame", "remote", "flood") else trial.injected
    # A swapped frame is late by one, and no new sample any more.
    assert frames - BLOCK + 1 - trial.accepted == missing


COUNT, AMPERE = 1e-7, 1e-4
# A step of x by 1000 counts a sample, and of y by 100.
SLOW_STAGE = StageParameters(motion=MotionParameters(speed=0.1, highest_speed=0.2))


class Board:
    """A receiver, and samples for it that stand still and come in time if nothing else is said."""

    def __init__(self, parameters=None, stage=SLOW_STAGE, **changes):
        parameters = parameters or CanParameters(**{"fd": True, "sample_memory": 10_000, "y_speed": 0.02, **changes})
        self.receiver = Receiver(parameters, stage)
        self.frames = self.receiver.wire.reports.values()
        self.number, self.start_ns = 0, START

    def sample(self, x=0, y=0, amplifier=State.ON, fault=0, good=True, referenced=True, current=0, late_ns=0, lost=0):
        """The next sample after ``lost`` ones, in counts; returns what was delivered of it, or None."""
        self.number += lost
        counter = self.number % (self.receiver.wire.number_modulus or 2**32)
        report = Report(0, counter, x * COUNT, y * COUNT, current * AMPERE, amplifier, fault, good, referenced)
        delivered = len(self.receiver.samples)
        for frames in self.frames:
            if self.number % frames.every == 0:
                alive = self.number // frames.every % frames.alive_modulus
                self.receive(frames.identifier, frames.pack(report._replace(alive=alive), 0), late_ns)
        self.number += 1
        return self.receiver.samples[-1] if len(self.receiver.samples) > delivered else None

    def receive(self, identifier, payload, late_ns=0):
        self.receiver.take(Frame(0, identifier, 0, payload), self.start_ns + self.number * PERIOD + late_ns)

    def samples(self, count, lost=0):
        """So many samples after ``lost`` ones."""
        self.number += lost
        for _ in range(count):
            self.sample()
        return self

    def settled(self):
        self.samples(BLOCK)
        assert self.receiver.clock.settled and not self.receiver.error_counter
        return self

    def newest(self, count):
        """The numbers of the newest samples that were delivered."""
        return [index for index, *_ in self.receiver.samples][-count:]

    def refused(self):
        return {reason: count for reason, count in self.receiver.counts.items() if count}


@pytest.fixture(params=[False, True], ids=["classic", "fd"])
def either(request):
    """A board on either kind of bus; on a classic one the current comes with every tenth sample."""
    return Board(fd=request.param)


@pytest.mark.parametrize("gap", [5, 14, 15, 16, 30, 31, 500])
def test_a_gap_of_any_length_costs_no_certainty_about_the_number_of_a_sample(either, gap):
    either.samples(500).samples(500, lost=gap)
    # A classic board's own count does not bridge ten: the next full counter does.
    lost = gap if gap < 10 or either.receiver.wire.fd else gap + -gap % 10
    assert either.newest(500 + gap - lost) == list(range(500 + lost, 1000 + gap))
    assert either.receiver.sequence.lost == lost and either.receiver.sequence.jumps == 0


def test_numbers_run_on_over_the_end_of_the_counter(either):
    last = either.receiver.wire.number_modulus
    either.number, either.start_ns = last - 500, START - last * PERIOD
    either.samples(1000)
    assert either.newest(800) == list(range(last - 300, last + 500))
    assert either.receiver.sequence.lost == 0 and not either.refused()


def test_a_silence_is_no_reason_to_believe_a_counter_from_another_time():
    board = Board().samples(500)
    board.number, board.start_ns = 900, board.start_ns - 399 * PERIOD
    assert board.sample() is None
    assert board.refused() == {"implausible": 1} and board.newest(1) == [499]


def test_a_boot_up_forgets_the_counter_of_the_board_before(either):
    either.number = 5000
    either.samples(500)
    either.receive(either.receiver.wire.heartbeat.identifier, b"\0")
    assert either.receiver.boot_ups == 1 and either.receiver.amplifier is None
    # It may be another board, or have lost it.
    assert either.receiver.referenced is None
    either.number, either.start_ns = 0, START + 5600 * PERIOD
    assert either.samples(300).newest(100) == list(range(200, 300))


def test_before_the_first_command_the_current_of_a_board_that_measures_none_is_zero():
    assert Board(BARE).settled().sample()[1].current == 0.0


def test_over_bad_readings_the_stage_goes_on_as_far_as_its_speed_allows():
    moving = Board().settled()
    for _ in range(3):
        moving.sample(good=False)
    # Four samples of 1000 counts after the last good one.
    assert moving.sample(x=4003) is None and moving.sample(x=5002)[1].x == pytest.approx(5002 * COUNT)


def test_samples_that_are_not_fetched_are_dropped_and_counted_oldest_first():
    board = Board(sample_memory=10).samples(500)
    assert board.newest(500) == list(range(490, 500))
    assert board.receiver.overflowed == 500 - BLOCK + 1 - 10


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


@pytest.mark.parametrize(("axis", "most"), [("x", 500 + 10), ("y", 500 + 100)])
def test_a_reading_may_move_by_two_counts_of_an_encoder_that_is_coarser_than_its_frame(axis, most):
    # 25 µm, and 1 µm a sample.
    encoder = EncoderParameters(x_resolution=250 * COUNT, y_resolution=250 * COUNT)
    board = Board(stage=StageParameters(encoder=encoder, motion=MotionParameters(speed=1e-3, highest_speed=2e-3)))
    board.settled()
    assert board.sample(**{axis: most}) and board.sample() and board.sample(**{axis: -most})
    assert board.sample(**{axis: most}) is None and board.refused() == {"implausible": 1}


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


def test_readings_that_the_board_says_are_bad_are_counted_and_not_delivered(board):
    received = board.receiver.received
    assert board.sample(good=False) is None
    assert board.refused() == {"encoders": 1} and board.receiver.received == received + 1
    # It was a good frame all the same: its number counts.
    assert board.sample()[0] == BLOCK + 1 and board.receiver.sequence.lost == 0


@pytest.mark.parametrize("current", [math.inf, math.nan, -1e30, 32.767])
def test_a_current_beyond_its_limits_is_counted_and_the_last_one_stays(current):
    board = Board(FOREIGN).samples(2 * BLOCK)
    board.sample(current=2000)
    frames = board.receiver.wire.sample
    payload = frames.pack(Report(board.number % frames.alive_modulus, x=0.0, y=0.0, current=0.1))
    board.receive(frames.identifier, forged(frames, payload, **{frames.fields["current"].name: current}))
    assert board.newest(1) == [board.number] and board.receiver.samples[-1][1].current == pytest.approx(0.2)
    assert board.refused() == {"current": 1}


@pytest.mark.parametrize("together", [True, False])
def test_a_status_whose_count_stands_still_is_counted_and_not_taken(tmp_path, together):
    text = share_path("config/board_motorola.dbc").read_text()
    counted = ' SG_ STATUS_CNT : 3|4@0+ (1,0) [0|15] "" PC\n SG_ STATUS_CRC'
    (tmp_path / "board.dbc").write_text(text.replace(" SG_ STATUS_CRC", counted))
    protection = FOREIGN.wire.protection
    protection = replace(protection, status=replace(protection.status, alive="STATUS_CNT"))
    wire = replace(FOREIGN.wire, protection=protection)
    receiver = Receiver(replace(FOREIGN, dbc=str(tmp_path / "board.dbc"), wire=wire), SLOW_STAGE)
    status, said = receiver.wire.homes["amplifier"], Report(amplifier=State.ON, fault=0)
    for turn in range(40):
        # Pages count together, or each by itself.
        alive = (turn if together else turn // len(status.pages)) % status.alive_modulus
        payload = status.pack(said._replace(alive=alive), turn)
        receiver.take(Frame(0, status.identifier, 0, payload), START + turn)
    assert receiver.sequence.repeated == 0 and (receiver.amplifier, receiver.board_fault) == (State.ON, 0)
    taken_ns = receiver.status_ns
    for late_ns in range(100, 103):
        receiver.take(Frame(0, status.identifier, 0, payload), START + late_ns)
    assert receiver.sequence.repeated == 3 and START + 38 <= receiver.status_ns == taken_ns


def test_a_bad_frame_adds_four_errors_a_good_one_takes_one_off_and_the_limit_begins_anew():
    board = Board(strike_limit=11).settled()
    bad = board.receiver.wire.sample.identifier, bytes(16)
    board.receive(*bad)
    board.receive(*bad)
    assert board.receiver.error_counter == 8 and board.refused() == {"crc": 2}
    board.sample()
    board.sample()
    assert (board.receiver.error_counter, board.receiver.error_limit_hits) == (6, 0)
    board.receive(*bad)
    assert (board.receiver.error_counter, board.receiver.error_limit_hits) == (10, 0)
    board.receive(*bad)
    assert (board.receiver.error_counter, board.receiver.error_limit_hits) == (0, 1)
    assert board.receiver.amplifier is None and not board.receiver.clock.settled and board.receiver.referenced
    for _ in range(20):
        board.sample()
    assert board.receiver.error_counter == 0


def test_a_sample_that_is_older_than_the_timeout_when_it_comes_is_stale_and_delivered():
    board = Board(sample_timeout=0.004).settled()
    assert board.sample(late_ns=4_000_000) and board.receiver.stale == 0
    assert board.sample(late_ns=4_001_000) and board.receiver.stale == 1


def test_errors_that_the_interface_reports_are_counted_by_their_classes(board):
    for classes, details in (
        (0x40, bytes(8)),
        (0x04, bytes([0, 0x10])),
        (0x04, bytes([0, 0x20])),
        (0x04, bytes([0, 0x04])),
        (0x04, b"\x30"),
        (0x02, bytes([0, 0x30])),
    ):
        board.receiver.take(Frame(0, classes, ERROR, details), START)
    assert board.refused() == {"error_frames": 6, "bus_off": 1, "error_passive": 2}
    assert board.receiver.error_counter == 0


def test_a_heartbeat_tells_the_boards_state_and_its_time(board):
    heartbeat = board.receiver.wire.heartbeat.identifier
    # The highest bit is CiA 301's toggle bit of node guarding.
    operational = board.receiver.wire.meaning.heartbeat.operational_value
    for payload in (bytes([operational]), bytes([operational | 0x80])):
        board.receive(heartbeat, payload, late_ns=7)
        assert board.receiver.node_state == operational
        assert board.receiver.heartbeat_ns == START + board.number * PERIOD + 7
    assert board.receiver.boot_ups == 0 and board.receiver.amplifier is State.ON
    board.receive(heartbeat, b"\5\5")
    assert board.refused() == {"length": 1} and board.receiver.error_counter == 4


def test_the_truth_of_an_emulated_board_belongs_to_the_sample_of_its_number():
    truth = Truth(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    plain, reporting = Board().settled(), Board(simulated_stage=True).settled()
    emulator = EmulatorFrames(reporting.receiver.wire)
    identifier, truth_payload = emulator.truth_id, emulator.truth_payload
    assert identifier not in plain.receiver.identifiers
    reporting.receive(identifier, truth_payload(reporting.number, truth))
    assert reporting.sample()[2] == truth
    reporting.receive(identifier, truth_payload(reporting.number + 1, truth))
    assert reporting.sample()[2] is None
    assert reporting.sample()[2] == truth
    payload = truth_payload(reporting.number, truth)
    for wrong in (payload[:-1], damaged(payload, 0)):
        reporting.receive(identifier, wrong)
    assert reporting.sample()[2] is None
    # Nothing acts on it: it is counted, and is no error.
    assert reporting.refused() == {"truth": 2} and reporting.receiver.error_counter == 0


def test_stamps_never_run_backwards_when_the_clock_is_set_anew(board):
    newest = board.sample()[1].stamp_ns
    board.receiver.restart()
    # The host's clock seems to have gone back by ten periods: what would come before is not delivered.
    board.number -= 10
    stamps = [sample[1].stamp_ns for sample in (board.sample() for _ in range(2 * BLOCK)) if sample]
    assert stamps and stamps[0] > newest and set(np.diff(stamps)) == {PERIOD}


@pytest.mark.parametrize(
    ("can", "lost", "counted"),
    [(BARE, 1, 1), (BARE, 2, 2), (FOREIGN, 300, 0)],
    ids=["one", "two", "more than a short counter holds"],
)
def test_a_sample_lost_without_a_counter_is_found_by_the_clock_and_a_silence_beyond_a_short_one_starts_anew(
    can, lost, counted
):
    board = Board(can).samples(2 * BLOCK)
    assert board.receiver.sequence.lost == 0
    board.samples(3 * BLOCK, lost=lost)
    assert (board.receiver.sequence.lost, board.receiver.sequence.jumps) == (counted, can is FOREIGN)
    index, sample, _ = board.receiver.samples[-1]
    late_ns = sample.stamp_ns - START - (board.number - 1) * PERIOD
    assert (index - board.number + 1) % (board.receiver.wire.sample_modulus or 2**32) == 0
    assert abs(late_ns) < PERIOD / 10


TURN = 2**22
"""Counts of an encoder of 22 bits: 0.42 m, of which the stage's travel has several."""
NARROW = "18|22@1- (1E-007,0) [-0.2|0.2]"


def board_with(folder, x):
    """The package's board with another signal of x, which wraps."""
    file = folder / "board.dbc"
    text = share_path("config/straightcomp.dbc").read_text()
    file.write_text(text.replace("18|26@1- (1E-007,0) [-3.3554431|3.3554431]", x))
    return CanParameters(fd=True, dbc=str(file), wire=replace(shipped_wire(True), x_wraps=True), y_speed=0.02)


class WrappedMachine:
    """A board whose counter of x wraps, on a stage that the draw moves; what happens to it is drawn too."""

    def __init__(self, parameters, seed, stage):
        self.draw, self.board = random.Random(seed), Board(parameters, stage)
        self.receiver = self.board.receiver
        self.travel = round(stage.motion.stroke / COUNT)
        self.at = self.draw.randrange(self.travel)
        self.zero, self.referenced, self.good, self.wrong, self.used = 0, True, True, 0, 0
        self.watch, self.shift = ZeroWatch(stage), 0

    def samples(self, count, speed=0):
        for _ in range(count):
            self.move(speed)
            self.receiver.samples.clear()
            self.board.sample(x=self.at - self.zero, good=self.good, referenced=self.referenced)
            for _, sample, _ in self.receiver.samples:
                self.watch.look([sample], self.known)
                if self.known and not self.watch.finding:
                    self.used += 1
                    self.wrong += abs(sample.x - self.at * COUNT) > 1.5 * COUNT

    @property
    def known(self):
        return bool(self.receiver.referenced and not self.receiver.ambiguous)

    def move(self, counts):
        self.at = min(max(0, self.at + counts), self.travel)

    def home(self):
        """While it is homed a machine has no reference, and here samples are lost; homing ends at its mark."""
        self.referenced = False
        self.samples(3)
        self.board.number += 200
        self.referenced, self.zero, self.at = True, self.shift, self.draw.randrange(0, 1000)

    def move_index(self):
        """The index is found elsewhere, or where it was at first, by an encoder that has counted on."""
        if self.known and self.referenced and self.at < TURN // 4:
            self.samples(3)
            self.referenced = False
            self.samples(3)
            self.referenced, self.shift = True, self.draw.choice((0, 0, self.draw.randrange(-20_000, 20_000)))
            self.zero = self.shift
            self.samples(1)

    def lose(self):
        """The encoder counts from where the stage stands."""
        self.referenced, self.zero = False, self.at

    def restart(self):
        """The board restarts, and the stage was pushed meanwhile."""
        self.board.number, self.board.start_ns = 0, self.board.start_ns + self.board.number * PERIOD
        self.move(self.draw.randrange(-TURN, TURN))
        self.receiver.restart()

    def pause(self):
        """Samples are lost, and the stage moved on."""
        lost = self.draw.choice((3, 50, 4000))
        self.board.number += lost
        self.move(lost * self.draw.randrange(-900, 900))


@pytest.mark.parametrize("events", [400, pytest.param(20_000, marks=pytest.mark.nightly)])
def test_no_wrong_x_is_used_whatever_happens_to_the_reference_and_the_counter(tmp_path, events):
    stage = replace(SLOW_STAGE, motion=replace(SLOW_STAGE.motion, stroke=1.76))
    machine = WrappedMachine(board_with(tmp_path, NARROW), events, stage)
    machine.samples(BLOCK)
    kinds = machine.home, machine.home, machine.lose, machine.restart, machine.pause, machine.move_index
    for _ in range(events):
        machine.draw.choice(kinds)()
        machine.samples(BLOCK + 30, machine.draw.randrange(-900, 900))
    assert machine.wrong == 0 and machine.used > 5 * events


def test_a_turn_of_the_counter_that_is_alone_on_the_travel_needs_no_homing(tmp_path):
    short = replace(SLOW_STAGE, motion=replace(SLOW_STAGE.motion, stroke=0.3))
    for at in (0, 2_500_000, TURN // 2 - 1, TURN // 2):
        machine = WrappedMachine(board_with(tmp_path, NARROW), 1, short)
        machine.at = at
        machine.samples(3 * BLOCK)
        assert machine.used and not machine.wrong and not machine.receiver.ambiguous


@pytest.mark.parametrize("good", [True, False])
@pytest.mark.parametrize(
    ("counts", "stroke", "ambiguous"), [(3, 1.76, False), (-3, 1.76, True), (-3, 0.3, False), (TURN // 2, 1.76, False)]
)
def test_after_homing_x_is_in_the_turn_of_its_reference_or_just_before_a_counter_that_begins_there(
    tmp_path, counts, stroke, ambiguous, good
):
    stage = replace(SLOW_STAGE, motion=replace(SLOW_STAGE.motion, stroke=stroke))
    machine = WrappedMachine(board_with(tmp_path, "18|22@1+ (1E-007,0) [0|0.4]"), 1, stage)
    machine.at, machine.referenced = 0, False
    machine.samples(BLOCK)
    # The first frame with a reference may have no good reading.
    machine.referenced, machine.zero, machine.good = True, -counts, good
    machine.samples(1)
    machine.good = True
    machine.samples(1)
    assert machine.receiver.ambiguous is ambiguous
    assert ambiguous or machine.receiver.samples[-1][1].x == pytest.approx(counts * COUNT)
