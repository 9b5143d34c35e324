"""Boards that say less: what is missing is told, and the driver holds the platform all the same."""

from dataclasses import replace
from pathlib import Path

import pytest

from straightcomp_ros.hardware.can.board_dbc import gaps
from straightcomp_ros.hardware.can.can_parameters import (
    SHIPPED_DBC,
    CanParameters,
    ProtectedMessages,
    ProtectionParameters,
    SignalParameters,
    shipped_wire,
)
from straightcomp_ros.hardware.can.frames import Amplifier, Report
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.hardware.interface import State
from straightcomp_ros.parameters.node_parameters import node_parameters
from straightcomp_ros.parameters.parameter_file import shipped_parameters
from straightcomp_ros.parameters.share import share_path
from straightcomp_ros.stage.description import StageParameters
from straightcomp_ros.straightness.guide_map import MapParameters, load_map
from trials.bench.can_servo_trial import run_servo_trial

STAGE = StageParameters()
PERIOD = STAGE.period_ns


def board(file):
    return node_parameters("driver", shipped_parameters(stage=str(file))).can


BARE = board(Path(__file__).with_name("bare.yaml"))
SPLIT = board(Path(__file__).with_name("split.yaml"))
FOREIGN = board(share_path("config/board_motorola.yaml"))


def without_counts(can):
    """The board of split.yaml without CRCs, counters and echo."""
    wire = replace(can.wire, protection=ProtectedMessages(), echo=SignalParameters())
    return replace(can, wire=wire)


def test_the_packages_own_frames_leave_nothing_open():
    assert gaps(CanParameters(fd=False).make_wire()) == gaps(CanParameters(fd=True).make_wire()) == []


def test_what_the_frames_of_a_board_lack_is_told():
    told = " ".join(gaps(BARE.make_wire()))
    for words in (
        "SAMPLE has no CRC",
        "SAMPLE has no counter",
        "whether the readings are good",
        "the commanded one stands for it",
        "no heartbeat",
        "SET has no CRC",
        "SET has no counter",
        "SET has no echo",
        "SET has no reset",
    ):
        assert words in told
    assert [text.split(":")[0] for text in gaps(FOREIGN.make_wire())] == [
        "DSP_MEAS counts to 256 only",
        "there is no heartbeat",
    ]


def test_what_messages_of_one_sample_or_one_command_lack_is_told():
    assert [text.split(":")[0] for text in gaps(SPLIT.make_wire())] == [
        "DSP_X counts to 15 only",
        "DSP_I has no CRC",
        "there is no heartbeat",
    ]
    told = " ".join(gaps(without_counts(SPLIT).make_wire()))
    for words in (
        "DSP_Y has no CRC: a damaged sample",
        "DSP_X and DSP_Y have no counter in each: frames that come within half a period",
        "DSP_X and DSP_Y have no counter: repeated samples",
        "PC_SWITCH has no CRC: the board would act",
        "PC_SWITCH and PC_CURRENT have no counter in each",
    ):
        assert words in told


def test_what_a_message_between_the_samples_says_without_a_crc_is_told():
    values = shipped_parameters(stage=str(share_path("config/board_motorola.yaml")))
    values["driver"] |= {"can.wire.protection.status.profile": "none", "can.wire.protection.status.crc": ""}
    foreign = gaps(node_parameters("driver", values).can.make_wire())
    assert "DSP_STATUS has no CRC: a damaged state of the amplifier or fault code is believed" in foreign
    assert "DSP_I has no CRC: a damaged measured current is believed" in gaps(SPLIT.make_wire())
    wire = shipped_wire(fd=False)
    bare = replace(wire, protection=replace(wire.protection, current=ProtectionParameters()))
    classic = CanParameters(dbc=str(share_path(SHIPPED_DBC)), wire=bare, fd=False)
    assert gaps(classic.make_wire()) == [
        "CoilCurrent has no CRC: a damaged number of a sample or measured current is believed"
    ]


def test_the_servo_holds_the_platform_by_a_board_that_says_only_what_it_must():
    guide = load_map(MapParameters(file="config/guide_synthetic.csv"))
    trial = run_servo_trial({}, guide, BARE, frames=2000)
    assert trial.state is State.ON and trial.latched == {} and trial.on > 0.9
    assert trial.unflagged_wrong == trial.unsafe == 0
    # Lost samples are noticed late, but the servo stays on and the numbers come right again.
    lossy = run_servo_trial({"drop": 0.002}, guide, BARE, frames=3000)
    assert lossy.injected["drop"] > 0 and lossy.state is State.ON and lossy.on > 0.9 and lossy.unsafe == 0


def test_the_servo_holds_the_platform_by_samples_and_commands_that_are_put_together_by_their_times():
    guide = load_map(MapParameters(file="config/guide_synthetic.csv"))
    board = without_counts(SPLIT)
    trial = run_servo_trial({}, guide, board, frames=2000)
    assert trial.state is State.ON and trial.latched == {} and trial.on > 0.9
    assert trial.unflagged_wrong == trial.unsafe == 0
    # As of any board without a counter, the lost samples' numbers come right again late.
    lossy = run_servo_trial({"drop": 0.002}, guide, board, frames=4000)
    assert lossy.injected["drop"] > 5 and lossy.state is State.ON and lossy.on > 0.9 and lossy.unsafe == 0


def test_a_fault_that_only_the_code_tells_is_latched_and_cleared():
    guide = load_map(MapParameters(file="config/guide_synthetic.csv"))
    trial = run_servo_trial({"cut": 0.001}, guide, BARE, frames=4000, seed=2)
    assert trial.injected["cut"] >= 2 and trial.latched and trial.unsafe == trial.unflagged_wrong == 0
    assert trial.on > 0.3


def feed(receiver, numbers):
    wire = receiver.wire
    for number in numbers:
        alive = number % (wire.sample.counts("alive") or 1)
        payload = wire.sample.pack(Report(alive, None, 1e-5, 0.0, 0.0, Amplifier.ON, 0, True), 0)
        receiver.receive(wire.sample.identifier, payload, 10**18 + number * PERIOD)


@pytest.mark.parametrize("lost", [1, 2])
def test_a_sample_lost_without_a_counter_is_found_by_the_clock(lost):
    receiver = Receiver(BARE, STAGE)
    feed(receiver, range(2 * BLOCK))
    assert receiver.sequence.lost == 0
    feed(receiver, range(2 * BLOCK + lost, 4 * BLOCK))
    assert receiver.sequence.lost == lost
    index, sample, _ = receiver.samples[-1]
    assert index == 4 * BLOCK - 1 and abs(sample.stamp_ns - 10**18 - index * PERIOD) < PERIOD / 10


def test_a_silence_beyond_a_short_counter_starts_the_numbers_and_the_clock_anew():
    receiver = Receiver(FOREIGN, STAGE)
    feed(receiver, range(2 * BLOCK))
    feed(receiver, range(2 * BLOCK + 300, 5 * BLOCK + 300))
    assert receiver.sequence.jumps == 1 and receiver.sequence.lost == 0
    index, sample, _ = receiver.samples[-1]
    assert index % 256 == (5 * BLOCK + 299) % 256
    assert abs(sample.stamp_ns - 10**18 - (5 * BLOCK + 299) * PERIOD) < PERIOD / 10


def test_the_state_of_the_amplifier_may_come_between_the_samples():
    receiver = Receiver(FOREIGN, STAGE)
    feed(receiver, range(BLOCK))
    assert receiver.amplifier is None
    status = receiver.wire.status
    report = Report(amplifier=Amplifier.FAULT, fault=34)
    for turn in range(2):
        receiver.receive(status.identifier, status.pack(report, turn), 10**18 + turn)
    assert receiver.amplifier is Amplifier.FAULT and receiver.board_fault == 34
    assert receiver.status_ns == 10**18
