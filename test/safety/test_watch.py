"""What a working machine cannot do is found, and what it can do is not."""

import math
import random

import pytest

from straightcomp_ros.hardware.interface import Sample
from straightcomp_ros.model.stage import MotionParameters, Trajectory, forward_and_back
from straightcomp_ros.safety.watch import ClockWatch, CommandWatch, SampleWatch, StageWatch, WatchParameters

T = 500_000
COUNT = 1e-7


def watch():
    return SampleWatch(WatchParameters(), T)


def fed(samples, currents=None):
    """The first finding in samples of (x, y), and its place."""
    found = watch()
    for place, (x, y) in enumerate(samples):
        finding = found.check(Sample(place * T, x, y, 0.0), currents[place] if currents else 0.0)
        if finding:
            return place, finding[0]
    return None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_sample_that_is_not_finite_is_found_in_x_and_in_y(bad):
    assert fed([(0.0, 0.0), (bad, 0.0)]) == (1, "sample_not_finite")
    assert fed([(0.0, 0.0), (0.0, bad)]) == (1, "sample_not_finite")
    assert fed([(bad, 0.0)]) == (0, "sample_not_finite")


def test_x_that_jumps_is_found_and_x_at_full_speed_is_not():
    assert fed([(0.0, 0.0), (0.002, 0.0)]) == (1, "x_jump")
    assert fed([(0.9 * 2.0 * T * 1e-9 * k, COUNT * k) for k in range(100)]) is None


def test_lost_samples_are_no_jump():
    found = watch()
    assert found.check(Sample(0, 0.0, 0.0, 0.0), 0.0) is None
    assert found.check(Sample(100 * T, 0.05, 0.0, 0.0), 0.0) is None
    assert found.check(Sample(101 * T, 0.06, 0.0, 0.0), 0.0) == (
        "x_jump",
        "x went from 50.0000 to 60.0000 mm within one sample",
    )


def test_y_that_leaves_its_limit_is_found_and_y_that_comes_back_is_not():
    found = watch()
    assert found.check(Sample(0, 0.0, 1.2e-3, 0.0), 0.0) is None
    found.hold()
    assert found.check(Sample(T, 0.0, 1.1e-3, 0.0), 0.0) is None
    assert found.check(Sample(2 * T, 0.0, 0.9e-3, 0.0), 0.0) is None
    found.hold()
    assert found.check(Sample(3 * T, 0.0, -1.1e-3, 0.0), 0.0)[0] == "y_out_of_range"
    found.switched()
    assert found.check(Sample(4 * T, 0.0, -1.1e-3, 0.0), 0.0) is None


def test_y_that_stays_although_the_current_has_moved_is_frozen():
    currents = [0.0] * 100 + [0.5] * 200
    place, name = fed([(0.0, 5 * COUNT)] * 300, currents)
    assert name == "y_frozen" and 100 < place < 200


def test_a_platform_at_rest_is_not_frozen_and_neither_is_a_law_that_switches():
    assert fed([(0.0, 5 * COUNT)] * 5000, [0.05] * 5000) is None
    assert fed([(0.0, 5 * COUNT)] * 5000, [0.3 * (-1) ** k for k in range(5000)]) is None
    random.seed(1)
    moving = [(0.0, COUNT * round(10 * math.sin(0.01 * k) + random.random())) for k in range(5000)]
    assert fed(moving, [0.8 * math.sin(0.003 * k) for k in range(5000)]) is None


def test_a_switched_off_amplifier_makes_nothing_frozen():
    found = watch()
    for place in range(3000):
        if place == 1000:
            found.switched()
        current = 0.5 if place < 1000 else 0.0
        finding = found.check(Sample(place * T, 0.0, COUNT * (place if place < 1000 else 1000), 0.0), current)
        assert finding is None


def test_x_that_stays_while_the_stage_is_to_move_is_frozen():
    trajectory = Trajectory(forward_and_back(MotionParameters()))
    stage = StageWatch(WatchParameters())
    assert stage.check(0, 0.0) is None
    stage.follow(trajectory, 0, 0.0)
    for at_ns in range(0, trajectory.end_ns + 10**9, 50_000_000):
        assert stage.check(at_ns, trajectory.position(at_ns)) is None
    stage.follow(trajectory, 0, 0.0)
    frozen = trajectory.position(2_000_000_000)
    found = [
        at_ns
        for at_ns in range(0, 4_000_000_000, 50_000_000)
        if stage.check(at_ns, min(trajectory.position(at_ns), frozen))
    ]
    assert len(found) == 1 and 2_000_000_000 < found[0] < 2_300_000_000


def test_a_second_controller_is_found_and_now_and_then_a_repetition_is_none():
    commands = CommandWatch()
    findings = []
    for _ in range(10):
        commands.good()
        findings.append(commands.again())
    assert [bool(finding) for finding in findings].index(True) == 4
    commands = CommandWatch()
    for _ in range(100):
        assert commands.again() is None
        for _ in range(5):
            commands.good()


class Clocks:
    """Both clocks at hand; each reading of the monotonic one takes ``reading_ns``."""

    def __init__(self):
        self.monotonic, self.offset, self.reading_ns = 1_000_000_000, 5_000_000_000_000, 1000

    def monotonic_ns(self):
        self.monotonic += self.reading_ns
        return self.monotonic

    def system_ns(self):
        return self.monotonic + self.offset

    def watch(self):
        found = ClockWatch(WatchParameters(clock_step=0.05), self.monotonic_ns, self.system_ns)
        found.restart()
        return found

    def seen_by(self, found):
        return found.check(self.monotonic_ns(), self.system_ns())


@pytest.mark.parametrize("step_s", [-1.0, -0.06, 0.06, 3600.0])
def test_a_step_of_the_systems_clock_is_found_once(step_s):
    clocks = Clocks()
    found = clocks.watch()
    assert clocks.seen_by(found) is None
    clocks.offset += round(step_s * 1e9)
    name, words = clocks.seen_by(found)
    assert name == "clock_jump"
    assert f"{step_s:+.3f} s" in words
    assert clocks.seen_by(found) is None


def test_a_clock_that_is_slewed_is_followed():
    clocks = Clocks()
    found = clocks.watch()
    for _ in range(100):
        clocks.offset += 10_000_000
        assert clocks.seen_by(found) is None
        found.follow()


def test_a_process_that_stood_still_between_two_readings_has_seen_no_step():
    clocks = Clocks()
    found = clocks.watch()
    before = clocks.monotonic_ns()
    clocks.monotonic += 200_000_000
    assert found.check(before, clocks.system_ns()) is None
    clocks.offset += 1_000_000_000
    clocks.reading_ns = 200_000_000
    assert clocks.seen_by(found) is None
    clocks.reading_ns = 1000
    assert clocks.seen_by(found) is not None
