"""What becomes of a command: the machine gets it once for each sample, in range and in time, or never."""

import math

import pytest

from straightcomp_ros.runtime.command_intake import CommandIntake
from straightcomp_ros.safety.faults import Fault

TIMEOUT_NS, LIMIT = 20_000_000, 0.9


class Machine:
    def __init__(self):
        self.written = []

    def write(self, current, at_ns, stamp_ns):
        self.written.append((stamp_ns, at_ns, current))


@pytest.fixture
def trips():
    return []


@pytest.fixture
def machine():
    return Machine()


@pytest.fixture
def intake(machine, trips):
    return CommandIntake(machine, TIMEOUT_NS, LIMIT, lambda name, reason: trips.append((name, reason)))


def test_a_command_goes_to_the_machine_with_its_sample_and_its_latency(intake, machine, trips):
    intake.accept(1000, -0.9, 61_000)
    assert machine.written == [(1000, 61_000, -0.9)]
    assert (intake.stamp_ns, trips) == (1000, [])
    assert intake.take_latency() == pytest.approx(60e-6)
    assert math.isnan(intake.take_latency())
    counters = intake.counters()
    assert (counters["commands"], counters["stale_commands"]) == (1, 0)


def test_a_command_older_than_the_timeout_is_stale_and_one_as_old_is_not(intake, machine, trips):
    intake.accept(1000, 0.1, 1000 + TIMEOUT_NS + 1)
    assert machine.written == []
    assert intake.counters()["stale_commands"] == 1
    intake.accept(1000, 0.1, 1000 + TIMEOUT_NS)
    assert len(machine.written) == 1
    assert trips == []


@pytest.mark.parametrize(
    ("current", "name"),
    [
        (0.900001, Fault.COMMAND_OUT_OF_RANGE),
        (-1e300, Fault.COMMAND_OUT_OF_RANGE),
        (math.nan, Fault.COMMAND_NOT_FINITE),
        (math.inf, Fault.COMMAND_NOT_FINITE),
    ],
)
def test_a_command_that_no_machine_may_get_trips_and_leaves_its_sample_unanswered(
    intake, machine, trips, current, name
):
    intake.accept(1000, current, 2000)
    assert machine.written == []
    assert intake.stamp_ns == 0
    assert [found for found, _ in trips] == [name]
    assert f"{current} A" in trips[0][1]
    assert "±0.9 A" in trips[0][1]
    assert intake.counters()["commands"] == 0


def test_samples_answered_again_and_again_mean_two_controllers(intake, machine, trips):
    for sample in range(1, 100):
        intake.accept(sample * 500_000, 0.1, sample * 500_000 + 1000)
        intake.accept(sample * 500_000, 0.2, sample * 500_000 + 2000)
        if trips:
            break
    assert trips[0][0] == Fault.TWO_CONTROLLERS
    assert all(current == 0.1 for _, _, current in machine.written)


def test_a_limit_that_changes_holds_from_the_next_command_on(intake, machine, trips):
    intake.current_limit = 0.5
    intake.accept(1000, 0.6, 2000)
    assert (machine.written, trips[0][0]) == ([], Fault.COMMAND_OUT_OF_RANGE)
