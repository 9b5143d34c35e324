"""The receiver behind a bad bus: every fault is counted, and no wrong sample is used."""

import math

import pytest

from straightcomp_ros.hardware.can.can_parameters import CanParameters
from straightcomp_ros.hardware.can.frames import Amplifier, Report
from straightcomp_ros.hardware.can.receiver import Receiver
from straightcomp_ros.hardware.can.sample_numbers import BLOCK
from straightcomp_ros.stage.description import StageParameters
from trials.bench.bus_faults_found import COUNTED
from trials.bench.can_fault_trial import position, run_trial

BUSES = pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
STAGE = StageParameters()
PERIOD = STAGE.period_ns


@BUSES
@pytest.mark.parametrize("kind", COUNTED)
def test_each_fault_is_found_as_often_as_it_was_made_and_no_wrong_sample_is_used(kind, fd):
    # Long enough that the stage turns round in it.
    trial = run_trial({kind: 0.02}, CanParameters(fd=fd), frames=12_500)
    assert trial.injected[kind] > 200
    assert trial.detected(kind) == trial.injected[kind]
    assert trial.unflagged_wrong == 0
    missing = 0 if kind in ("duplicate", "error_frame", "remote", "flood") else trial.injected[kind]
    # A swapped frame is late by one, and no new sample any more.
    assert trial.frames - BLOCK + 1 - trial.delivered == missing


@BUSES
def test_all_faults_together_let_no_wrong_sample_through(fd):
    trial = run_trial(dict.fromkeys(COUNTED, 0.01), CanParameters(fd=fd), seed=7)
    assert min(trial.injected.values()) > 50
    assert trial.unflagged_wrong == 0
    assert trial.delivered > 0.9 * trial.frames


def frames(wire, index, amplifier=Amplifier.ON, jump=0):
    """Identifiers and payloads that carry the sample ``index``; on a classic bus the current comes with every tenth."""
    x, y = position(index)
    index %= wire.number_modulus
    report = Report(0, index, x * 1e-7, (y + jump) * 1e-7, 0.025, amplifier, 0, True)
    for one in wire.reports.values():
        if index % one.every == 0:
            yield one.identifier, one.pack(report._replace(alive=index // one.every % 15), 0)


def feed(receiver, indices, start_ns=10**18, **options):
    for index in indices:
        for identifier, payload in frames(receiver.wire, index, **options):
            receiver.receive(identifier, payload, start_ns + index * PERIOD)


@pytest.fixture(params=[False, True], ids=["classic", "fd"])
def receiver(request):
    return Receiver(CanParameters(fd=request.param, sample_memory=10_000), STAGE)


@pytest.mark.parametrize("gap", [5, 14, 15, 16, 30, 31, 500])
def test_a_gap_of_any_length_costs_no_certainty_about_the_number_of_a_sample(receiver, gap):
    feed(receiver, range(500))
    feed(receiver, range(500 + gap, 1000 + gap))
    assert [index for index, *_ in receiver.samples][-500:] == list(range(500 + gap, 1000 + gap))[-500:]
    assert receiver.sequence.lost == gap and receiver.sequence.jumps == 0


def test_numbers_run_on_over_the_end_of_the_counter(receiver):
    last = receiver.wire.number_modulus
    for number in range(last - 500, last + 500):
        for identifier, payload in frames(receiver.wire, number):
            receiver.receive(identifier, payload, 10**18 + (number - last) * PERIOD)
    assert [index for index, *_ in receiver.samples][-800:] == list(range(last - 300, last + 500))
    assert receiver.sequence.lost == 0 and not any(receiver.counts.values())


def test_a_sample_too_far_from_the_one_before_is_refused(receiver):
    feed(receiver, range(500))
    feed(receiver, [500], jump=4000)
    feed(receiver, [501])
    assert receiver.counts["implausible"] == 1
    assert [index for index, *_ in receiver.samples][-2:] == [499, 501]


def test_the_coil_current_is_a_number_only_while_the_amplifier_is_on(receiver):
    feed(receiver, range(500))
    assert math.isfinite(receiver.samples[-1][1].current)
    feed(receiver, range(500, 501), amplifier=Amplifier.OFF)
    assert math.isnan(receiver.samples[-1][1].current)
    assert receiver.amplifier is Amplifier.OFF


def test_a_silence_is_no_reason_to_believe_a_counter_from_another_time():
    receiver = Receiver(CanParameters(fd=True), STAGE)
    feed(receiver, range(500))
    identifier, payload = next(frames(receiver.wire, 900))
    receiver.receive(identifier, payload, 10**18 + 501 * PERIOD)
    assert receiver.counts["implausible"] == 1
    assert receiver.samples[-1][0] == 499


def test_many_bad_frames_in_a_row_strike_out_and_begin_anew(receiver):
    feed(receiver, range(500))
    for _ in range(4):
        receiver.receive(receiver.wire.sample.identifier, bytes(receiver.wire.sample.size), 10**18 + 500 * PERIOD)
    assert receiver.error_limit_hits == 1 and receiver.amplifier is None
    feed(receiver, range(520, 1000))
    assert receiver.samples[-1][0] == 999


def test_a_boot_up_forgets_the_counter_of_the_board_before(receiver):
    feed(receiver, range(5000, 5500))
    receiver.receive(receiver.wire.heartbeat.identifier, b"\0", 10**18 + 5500 * PERIOD)
    assert receiver.boot_ups == 1 and receiver.amplifier is None
    feed(receiver, range(300), start_ns=10**18 + 5600 * PERIOD)
    assert [index for index, *_ in receiver.samples][-100:] == list(range(200, 300))


def test_samples_that_nobody_fetches_are_dropped_and_counted_oldest_first():
    receiver = Receiver(CanParameters(sample_memory=10), STAGE)
    feed(receiver, range(500))
    assert [index for index, *_ in receiver.samples] == list(range(490, 500))
    assert receiver.overflowed == 500 - BLOCK + 1 - 10
