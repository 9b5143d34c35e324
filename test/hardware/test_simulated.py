import dataclasses
import math
import tracemalloc

import pytest
from surveys import GUIDE

from straightcomp_ros.hardware.interface import HardwareError, State
from straightcomp_ros.hardware.simulated import SimulatedHardware, SimulatedParameters
from straightcomp_ros.model.converters import DriveParameters
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, forward_and_back
from straightcomp_ros.model.paced_motion import Pace
from straightcomp_ros.stage.description import StageParameters

STAGE = StageParameters()
PERIOD = STAGE.period_ns
START = 1_700_000_000_123_456_789


def machine(delay=1.0, on=True, x=0.0, rate=STAGE.rate, **parameters) -> SimulatedHardware:
    stage = dataclasses.replace(STAGE, rate=rate, drive=DriveParameters(delay=delay))
    hardware = SimulatedHardware(SimulatedParameters(**{"command_timeout": 1.0, **parameters}), stage, GUIDE, x)
    hardware.start(START)
    if on:
        hardware.enable()
    return hardware


def commanded(hardware, currents):
    """Command a current in each period, and fetch its sample; returns the currents that were applied."""
    applied = []
    for k, current in enumerate(currents):
        hardware.write(current, START + k * PERIOD)
        hardware.read(START + k * PERIOD)
        applied.append(hardware.applied_current)
    return applied


def test_samples_lie_on_the_grid_of_the_sampling_clock_and_are_the_same_whenever_they_are_fetched():
    def sampled(fetches):
        hardware = machine(initial_y=1e-5)
        hardware.write(0.02, START + 700_000)
        hardware.write(-0.01, START + 3_100_000)
        return [taken for at_ns in fetches for taken in hardware.read(START + at_ns)]

    samples = sampled(range(0, 10_000_000, PERIOD))
    assert [sample.stamp_ns for sample, _ in samples] == [START + k * PERIOD for k in range(20)]
    assert sampled([9_999_999]) == sampled([0, 100_000, 1_234_567, 1_300_000, 9_999_999]) == samples


def test_a_host_that_is_late_finds_what_the_memory_holds_and_the_rest_is_counted_as_lost():
    hardware = machine(sample_memory=16 * PERIOD * 1e-9)
    samples = hardware.read(START + 99 * PERIOD)
    assert len(samples) == 16 and samples[-1][0].stamp_ns == START + 99 * PERIOD
    assert hardware.lost_samples == 84
    # However late: of 5000 samples no more is kept meanwhile than of 16.
    tracemalloc.start()
    hardware.read(START + 5099 * PERIOD)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 100_000 and hardware.lost_samples == 84 + 4984


def test_when_the_next_command_is_late_the_board_goes_back_to_the_mean_of_those_before():
    hardware = machine(hold_after=2.5, hold_stiffness=0.0, hold_braking=0.0)
    last = commanded(hardware, [0.05 + (0.2 if k % 2 else -0.2) for k in range(400)])[-1]
    assert last == pytest.approx(0.25, abs=1e-3)
    hardware.read(START + 401 * PERIOD)  # two periods after the last command
    assert hardware.applied_current == last
    hardware.read(START + 402 * PERIOD)
    assert hardware.applied_current == pytest.approx(0.05, abs=0.01)
    hardware.write(0.1, START + 403 * PERIOD)
    hardware.read(START + 404 * PERIOD)
    assert hardware.applied_current == pytest.approx(0.1, abs=1e-3)


def test_a_command_waits_for_its_fixed_time_after_the_sample_that_it_answers():
    def applied(delay, arrival, sample):
        hardware = machine(delay, hold_after=10.0)
        hardware.read(START)
        hardware.write(0.1, START + arrival, sample)
        return [sample.current for sample, _ in hardware.read(START + 3 * PERIOD)]

    early, prompt = (applied(1.0, arrival, START) for arrival in (PERIOD // 8, PERIOD // 2))
    assert early == prompt and early[0] == 0.0 < early[1]
    assert applied(1.0, PERIOD // 8, START) == applied(0.0, PERIOD, START)
    # Later than that it acts when it comes; without a sample named, always.
    assert applied(1.0, 3 * PERIOD // 2, START) == applied(0.0, 3 * PERIOD // 2, START)
    assert applied(1.0, PERIOD // 8, None) == applied(0.0, PERIOD // 8, START) != early
    for delay in (0.1, 0.25, 0.5):
        due = round(delay * PERIOD)
        assert applied(delay, due // 2, START) == applied(0.0, due, START)
        assert applied(delay, due + PERIOD // 20, START) == applied(0.0, due + PERIOD // 20, START)
    # A sample that is yet to come is taken for the newest.
    assert applied(1.0, PERIOD // 8, START + 10**12) == early


def test_while_commands_are_late_the_board_takes_back_what_the_last_one_gave_beyond_the_mean():
    def moved(hold_braking):
        hardware = machine(hold_braking=hold_braking, hold_stiffness=0.0)
        commanded(hardware, [0.0] * 399 + [0.08])
        before, after = (hardware.read(START + k * PERIOD)[-1][1].y for k in (400, 408))
        return after - before

    assert 0.0 < moved(hold_braking=0.5) < 0.5 * moved(hold_braking=0.0)


@pytest.mark.parametrize("push", [-0.05, 0.05])  # A; 2.2 N is far more than friction holds
def test_a_stiffness_keeps_the_platform_where_it_was_when_commands_cease(push):
    def moved(hold_stiffness):
        hardware = machine(hold_stiffness=hold_stiffness)
        commanded(hardware, [push] * 7)
        hardware.write(push, START + 7 * PERIOD)
        before, *after = (truth.y for _, truth in hardware.read(START + 200 * PERIOD))
        return max(abs(y - before) for y in after), abs(after[-1] - before), abs(after[-1] - after[-2])

    farthest, _, _ = moved(0.0)
    assert farthest > 1e-3  # at the mechanical stop
    farthest, last, motion = moved(SimulatedParameters().hold_stiffness)
    assert farthest < 50e-6 and last < 20e-6 and motion < 0.1e-6


def test_the_true_state_is_within_half_a_count_of_the_reading():
    hardware = machine(on=False, initial_y=1.234e-5)
    hardware.move(Trajectory(forward_and_back(MotionParameters(settle=0.0))), START)
    for sample, truth in hardware.read(START + 200 * PERIOD)[-100:]:
        assert abs(sample.x - truth.x) <= 0.51e-7 and abs(sample.y - truth.y) <= 0.51e-7
        assert truth.guide_deviation == GUIDE.deviations(truth.x)


def test_command_older_than_timeout_disables_the_amplifier_and_latches_a_fault():
    hardware = machine(command_timeout=0.005)
    hardware.write(0.1, START)
    assert hardware.read(START + 9 * PERIOD) and hardware.state is State.ON
    late = hardware.read(START + 30 * PERIOD)
    assert hardware.state is State.FAULT and "no command for 5.5 ms" in hardware.fault[1]
    assert math.isnan(late[-1][0].current)
    with pytest.raises(HardwareError, match="no command"):
        hardware.enable()
    hardware.reset_fault()
    assert hardware.state is State.OFF and hardware.fault is None
    hardware.enable()
    hardware.write(0.1, START + 31 * PERIOD)
    hardware.read(START + 32 * PERIOD)
    assert hardware.state is State.ON and hardware.applied_current > 0.09
    hardware.close()
    hardware.read(START + 36 * PERIOD)
    assert hardware.state is State.OFF and hardware.applied_current == 0.0


def test_a_disabled_amplifier_ignores_commands_and_the_magnets_let_go():
    hardware = machine(on=False, command_timeout=0.005, initial_y=1e-4)
    hardware.write(0.5, START)
    samples = hardware.read(START + 100 * PERIOD)
    assert all(math.isnan(sample.current) for sample, _ in samples)
    assert samples[-1][1].magnetic_force == pytest.approx(0.0, abs=1e-9)


def test_what_cannot_be_done_is_refused():
    hardware = machine()
    for current in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="not finite"):
            hardware.write(current, START)
        assert hardware.applied_current == 0.0
    with pytest.raises(ValueError, match=r"starts at 0\.5 m, but the stage stands at 0\.0 m"):
        hardware.move(Trajectory([Waypoint(0, 0.5, 0.0)]), START)


@pytest.mark.parametrize("count", [3, 16, 17, 100])
def test_commands_that_wait_take_effect_in_their_order_however_many_they_are(count):
    hardware = machine(0.0, hold_after=10.0)
    for k in range(count):
        hardware.write(1e-3 * k, START + k * PERIOD)
    # One that names an earlier time does not overtake those before it.
    hardware.write(-0.1, START)
    applied = [hardware.applied_current for k in range(count + 1) if hardware.read(START + k * PERIOD)]
    step = STAGE.drive.current_step
    assert applied[: count - 1] == pytest.approx([1e-3 * k for k in range(count - 1)], abs=step)
    assert applied[count - 1 :] == pytest.approx([-0.1, -0.1], abs=step)


def test_homing_finds_the_index_where_it_is_now_and_ends_at_the_start_of_the_strokes():
    hardware = machine(on=False, x=0.1, referenced=False, index=0.05, index_shift=0.001)
    ((sample, _),) = hardware.read(START)
    assert sample.x == 0.0 and hardware.unreferenced
    hardware.home(START)
    sample, truth = hardware.read(START + 4000 * PERIOD)[-1]
    assert not hardware.unreferenced and sample.x == 0.0 and truth.x == pytest.approx(0.001)
    hardware.move(Trajectory(forward_and_back(STAGE.motion)), START + 4000 * PERIOD)
    hardware.enable()
    with pytest.raises(HardwareError, match="amplifier on"):
        hardware.home(START + 4000 * PERIOD)


@pytest.mark.parametrize("rate", [100, 500])
def test_homing_finds_the_index_wherever_the_samples_fall(rate):
    for k in range(40):
        hardware = machine(on=False, x=0.1 + 1e-4 * k, rate=rate, referenced=False, index=0.05)
        hardware.home(START)
        hardware.read(START + 4 * 10**9)
        assert not hardware.unreferenced


@pytest.mark.parametrize("replaced", [False, True], ids=["ended", "replaced"])
def test_homing_that_ends_before_the_index_says_so_until_it_is_repeated(replaced):
    hardware = machine(on=False, x=0.2, referenced=False, index=0.05)
    hardware.home(START)
    hardware.pace(Pace(hold=replaced, end=not replaced))
    time_ns = START + 200 * PERIOD
    hardware.read(time_ns)
    if replaced:
        # Held on its way it is still being homed.
        assert hardware.unreferenced == "it is being homed"
        x = hardware.motion.position(time_ns) - hardware.zero
        hardware.move(Trajectory([Waypoint(0, x, 0.0)]), time_ns)
    assert hardware.unreferenced == "homing ended before the index; call home again"
    hardware.home(time_ns)
    hardware.pace(Pace())
    hardware.read(time_ns + 100 * PERIOD)
    assert hardware.unreferenced == "it is being homed"
    hardware.read(time_ns + 8000 * PERIOD)
    assert not hardware.unreferenced
