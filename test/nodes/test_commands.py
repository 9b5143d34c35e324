"""What becomes of a command: the machine gets it once for each sample, in range and in time, or never."""

import math
from types import SimpleNamespace

import pytest

from straightcomp_ros.runtime.commands import CommandIntake
from straightcomp_ros.safety.faults import Fault

TIMEOUT_NS, PERIOD_NS, LIMIT = 20_000_000, 500_000, 0.9


@pytest.fixture
def trips():
    return []


@pytest.fixture
def written():
    """What the machine was given: stamp, time and current of each command."""
    return []


@pytest.fixture
def intake(written, trips):
    """With one sample handed out, of time 1000."""
    machine = SimpleNamespace(write=lambda current, at_ns, stamp_ns: written.append((stamp_ns, at_ns, current)))
    intake = CommandIntake(machine, TIMEOUT_NS, PERIOD_NS, LIMIT, lambda name, reason: trips.append((name, reason)))
    intake.hand_out(1000)
    return intake


def test_a_command_goes_to_the_machine_with_its_sample_and_its_latency(intake, written, trips):
    intake.accept(1000, -0.9, 61_000)
    assert (written, intake.stamp_ns, trips) == ([(1000, 61_000, -0.9)], 1000, [])
    assert intake.take_latency() == pytest.approx(60e-6)
    assert math.isnan(intake.take_latency())
    counters = intake.counters()
    assert (counters["commands"], counters["stale_commands"]) == (1, 0)


def test_an_older_sample_is_not_answered_after_a_newer_one(intake, written, trips):
    intake.hand_out(2000)
    intake.accept(2000, 0.1, 3000)
    intake.accept(1000, 0.2, 3000)
    assert ([stamp_ns for stamp_ns, *_ in written], trips) == ([2000], [])


@pytest.mark.parametrize(
    ("limit", "current", "fault"),
    [
        (LIMIT, 0.900001, Fault.COMMAND_OUT_OF_RANGE),
        (LIMIT, -1e300, Fault.COMMAND_OUT_OF_RANGE),
        (LIMIT, math.nan, Fault.COMMAND_NOT_FINITE),
        (LIMIT, math.inf, Fault.COMMAND_NOT_FINITE),
        # A limit that changes holds from the next command on.
        (0.5, 0.6, Fault.COMMAND_OUT_OF_RANGE),
    ],
)
def test_a_command_that_no_machine_may_get_trips_and_leaves_its_sample_unanswered(
    intake, written, trips, limit, current, fault
):
    intake.current_limit = limit
    intake.accept(1000, current, 2000)
    ((found, reason),) = trips
    assert found is fault and f"{current} A" in reason and f"±{limit} A" in reason
    assert (written, intake.stamp_ns, intake.counters()["commands"]) == ([], 0, 0)


def answered(intake, samples, between=lambda stamp_ns: None):
    """The newest stamp of samples that a sound controller has answered; ``between`` follows each."""
    for sample in range(1, samples + 1):
        stamp_ns = sample * PERIOD_NS
        intake.hand_out(stamp_ns)
        intake.accept(stamp_ns, 0.1, stamp_ns + 60_000)
        between(stamp_ns)
    return stamp_ns


@pytest.mark.parametrize(("every", "found"), [(1, True), (200, True), (6600, True), (6800, False)])
def test_four_samples_answered_again_within_ten_seconds_mean_two_controllers(intake, written, trips, every, found):
    def repeat(stamp_ns):
        if stamp_ns // PERIOD_NS % every == 0:
            intake.accept(stamp_ns, 0.2, stamp_ns + 70_000)
            numbers.append(len(trips))

    numbers = []
    answered(intake, 7 * every, repeat)
    # Those of a fault do not count for the next one.
    assert numbers == [0, 0, 0, *[int(found)] * 4]
    assert {fault for fault, _ in trips} <= {Fault.TWO_CONTROLLERS}
    assert all(current == 0.1 for _, _, current in written)


HOUR_NS = 3600 * 10**9


@pytest.mark.parametrize("offset_ns", [-HOUR_NS, -300_000_000, -1, 1, 60_000, 50_000_000, HOUR_NS, None])
def test_one_command_for_a_sample_that_was_not_handed_out_is_a_fault_and_stops_no_later_command(
    intake, written, trips, offset_ns
):
    newest_ns = answered(intake, 2000)
    foreign_ns = -5 if offset_ns is None else newest_ns + offset_ns
    intake.accept(foreign_ns, 0.5, newest_ns + 70_000)
    assert [fault for fault, _ in trips] == [Fault.TWO_CONTROLLERS]
    assert (intake.stamp_ns, written[-1][0]) == (newest_ns, newest_ns)
    assert intake.counters()["foreign_commands"] == 1
    intake.restart()
    assert intake.stamp_ns == 0
    newest_ns += PERIOD_NS
    intake.hand_out(newest_ns)
    intake.accept(newest_ns, 0.1, newest_ns + 60_000)
    assert (intake.stamp_ns, len(trips)) == (newest_ns, 1)


def test_a_controller_that_was_stopped_answers_late_which_is_no_fault_and_what_is_older_than_the_timeout_is_stale(
    intake, written, trips
):
    answered(intake, 10)
    stamps = [k * PERIOD_NS for k in range(11, 1000)]
    for stamp_ns in stamps:
        intake.hand_out(stamp_ns)
    for stamp_ns in stamps:
        intake.accept(stamp_ns, 0.1, stamps[-1])
    # The newest 20 ms, a command just as old among them, and nothing older, were still in time.
    in_time = stamps[-TIMEOUT_NS // PERIOD_NS - 1 :]
    assert not trips and [stamp_ns for stamp_ns, *_ in written[10:]] == in_time
    assert intake.counters()["stale_commands"] == len(stamps) - len(in_time)


@pytest.mark.parametrize("taken_since", [0, 3])
def test_commands_for_samples_of_before_a_fresh_start_are_stale_and_no_fault(intake, written, trips, taken_since):
    newest_ns = answered(intake, 10)
    intake.hand_out(newest_ns + PERIOD_NS)
    intake.restart()
    written.clear()
    for k in range(2, 2 + taken_since):
        intake.hand_out(newest_ns + k * PERIOD_NS)
    for stamp_ns in (newest_ns, newest_ns + PERIOD_NS):
        intake.accept(stamp_ns, 0.1, stamp_ns + 60_000)
    assert (written, trips, intake.stamp_ns) == ([], [], 0)
