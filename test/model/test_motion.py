"""Strokes as waypoints, the motion between them, and what a stage refuses."""

import itertools
import math
from contextlib import nullcontext
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly, CubicHermiteSpline

from straightcomp_ros.model.motion import (
    MotionParameters,
    StageLimits,
    Trajectory,
    Waypoint,
    cycles,
    forward_and_back,
    goals,
    move,
    trapezoid,
)
from straightcomp_ros.parameters.declaration import ParameterError

MOTION = MotionParameters()


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "no points"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(0, 1.0, 0.0)], "point 1.*not after"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(1, float("nan"), 0.0)], "point 1.*not finite"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(10, 1.0, 0.0), Waypoint(5, 2.0, 0.0)], "point 2.*5e-09 s.*not after 1e-08 s"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(1, 0.0, float("inf")), Waypoint(2, 0.0, 0.0)], "point 1.*not finite"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(10, 1.0, 0.5)], "end at rest"),
    ],
)
def test_a_bad_trajectory_is_refused_with_its_point(points, words):
    with pytest.raises(ValueError, match=words):
        Trajectory(points)


def test_equal_waypoints_in_a_row_are_one_wherever_they_stand():
    a, b, c = Waypoint(0, 0.0, 0.0), Waypoint(10, 1.0, 0.1), Waypoint(20, 2.0, 0.0)
    assert list(Trajectory([a, a, b, b, b, c, c]).waypoints) == [a, b, c]


def test_positions_at_many_times_are_those_of_each_to_the_last_bit():
    for motion in (MotionParameters(), MotionParameters(jerk=20.0), MotionParameters(settle=0.0, pause=0.0)):
        trajectory = Trajectory(forward_and_back(motion))
        times = np.random.default_rng(0).integers(-(10**9), trajectory.end_ns + 10**9, 5000)
        times = np.concatenate([times, trajectory.times, trajectory.times - 1])
        np.testing.assert_array_equal(trajectory.at(times), [trajectory.position(time) for time in times.tolist()])
    resting = Trajectory([Waypoint(0, 0.3, 0.0)])
    assert resting.at(np.array([-1, 0, 5])).tolist() == [0.3, 0.3, 0.3] and resting.largest_acceleration == 0.0


def test_a_move_too_short_to_cruise_has_one_corner_and_a_longer_one_two():
    # With 0.3 m/s and 0.2 m/s² the ramps take 0.45 m.
    start, near = Waypoint(5, 1.0, 0.0), partial(pytest.approx, rel=1e-12)
    short, long = (trapezoid(start, 1.0 - length, 0.3, 0.2) for length in (0.2, 0.6))
    assert short == [near((5 + 10**9, 0.9, -0.2)), near((5 + 2 * 10**9, 0.8, 0.0))]
    assert long[:2] == [near((5 + 1_500_000_000, 0.775, -0.3)), near((5 + 2 * 10**9, 0.625, -0.3))]
    assert long[2:] == [near((5 + 3_500_000_000, 0.4, 0.0))]
    assert trapezoid(start, 1.0, 0.3, 0.2) == []


def test_a_cycle_settles_goes_pauses_comes_back_and_settles_at_its_start():
    motion = MotionParameters(start=0.2, stroke=0.6, speed=0.3, acceleration=0.2, settle=1.0, pause=0.25)
    cycle = Trajectory(forward_and_back(motion))
    assert [(point.time_ns, point.position) for point in cycle.waypoints if point.velocity == 0.0] == [
        (0, 0.2),
        (1_000_000_000, 0.2),
        (4_500_000_000, pytest.approx(0.8)),
        (4_750_000_000, pytest.approx(0.8)),
        (8_250_000_000, 0.2),
        (9_250_000_000, 0.2),
    ]


def test_each_cycle_begins_where_and_when_the_one_before_ended():
    once, thrice = Trajectory(forward_and_back(MOTION)), Trajectory(cycles(MOTION, 3))
    assert thrice.end_ns == 3 * once.end_ns
    for at in range(0, once.end_ns, 500_000_000):
        assert [thrice.position(at + k * once.end_ns) for k in range(3)] == [once.position(at)] * 3


@pytest.mark.parametrize("seed", range(4))
def test_the_motion_is_the_cubic_spline_through_its_points_and_the_limits_that_hold_it_are_those_of_its_extremes(seed):
    random = np.random.default_rng(seed)
    times, positions, velocities = np.cumsum(random.uniform(0.5, 1.5, 5)), random.normal(size=5), random.normal(size=5)
    velocities[-1] = 0.0
    points = [Waypoint(round(t * 1e9), p, v) for t, p, v in zip(times, positions, velocities, strict=True)]
    trajectory, spline = Trajectory(points), CubicHermiteSpline(times, positions, velocities)
    for t in random.uniform(times[0], times[-1], 50):
        found = trajectory.position(t * 1e9), *trajectory.rates(t * 1e9)
        assert found == pytest.approx([float(spline(t, order)) for order in range(3)], rel=1e-6, abs=1e-6)
    for t, *position_and_speed in points:
        assert [trajectory.position(t), trajectory.rates(t)[0]] == pytest.approx(position_and_speed, abs=1e-15)
    assert trajectory.rates(times[0] * 1e9 - 1e3) == trajectory.rates(times[-1] * 1e9 + 1e3) == (0.0, 0.0)
    # It may be largest at a point, where the acceleration jumps.
    speed = np.abs(np.append(spline(np.linspace(times[0], times[-1], 100_001), 1), velocities)).max()
    cubes, squares = 6.0 * spline.c[0] * np.diff(times), 2.0 * spline.c[1]
    acceleration = np.abs([squares, cubes + squares]).max()
    assert trajectory.largest_acceleration == pytest.approx(acceleration)
    # Bézier's points enclose a cubic.
    around = BPoly.from_power_basis(spline).c
    holding = {"low": around.min(), "high": around.max(), "speed": speed, "acceleration": acceleration}
    scale = {"low": -1.0, "high": 1.0, "speed": speed, "acceleration": acceleration}
    for sign, less in itertools.product((1.0, -1.0), (None, *holding)):
        limits = {name: limit + (1e-6 if name != less else -1e-3) * scale[name] for name, limit in holding.items()}
        if sign < 0.0:
            limits |= {"low": -limits["high"], "high": -limits["low"]}
        turned = Trajectory([Waypoint(t, sign * p, sign * v) for t, p, v in points])
        with pytest.raises(ValueError, match="allowed for this stage") if less else nullcontext():
            StageLimits(**limits).check(turned)


LIMITS = StageLimits(low=-0.02, high=1.5, speed=2.0, acceleration=2.0)
S, MS, US = 10**9, 10**6, 10**3


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([(0, 0.0, 0.0), (S, 1e300, 0.0)], r"point 1: 1e\+300 m; allowed.* -0\.02 to 1\.5 m"),
        ([(0, 0.0, 0.0), (100 * S, -0.03, 0.0), (200 * S, 0.0, 0.0)], r"point 1: -0\.03 m"),
        # Beyond the range between two points that are within it.
        ([(0, 0.0, 0.0), (2 * S, 1.4, 1.0), (3 * S, 1.4, 0.0)], r"point 2: 1\.73\d* m"),
        ([(0, 0.0, 0.0), (US, 1e-3, 0.0)], r"point 1: 1499\.\d* m/s; allowed.* 0 to 2 m/s"),
        ([(0, 0.0, 0.0), (S, 1e-3, 1e300), (2 * S, 0.0, 0.0)], r"allowed"),
        ([(0, 0.0, 0.0), (5 * S, 0.5, -1e308), (9 * S, 0.0, 0.0)], "allowed"),
        ([(0, 0.0, 0.0), (MS, 1e-3, 0.0)], r"point 1: 5999\.\d* m/s²; allowed.* 0 to 2 m/s²"),
        ([(0, 0.0, 0.0), (1000, 1e-9, 1.9), (S // 2, 0.5, 0.0)], "m/s²"),
        ([(0, 0.0, 1.0), (2 * S, 1.0, 1.0), (2 * S + MS, 1.001, 0.0)], "point 2: .* m/s²"),
    ],
)
def test_a_trajectory_beyond_the_stage_is_refused_at_the_point_where_it_leaves_it(points, words):
    with pytest.raises(ValueError, match=words):
        LIMITS.check(Trajectory([Waypoint(*point) for point in points]))


@given(st.floats(-0.01, 1.4), st.floats(1e-9, 1.4), st.floats(0.001, 4 / 3), st.floats(0.01, 2.0), st.floats(0.0, 1e-7))
@example(1.0000000000000003e-09, 1e-9, 1.0, 1.0, 0.0)  # next to no way
def test_every_trapezoid_within_the_limits_is_taken(start, goal, speed, acceleration, excess):
    first = Waypoint(0, start, 0.0)
    trajectory = Trajectory([first, *trapezoid(first, goal, speed, acceleration)])
    LIMITS.check(trajectory)
    assert trajectory.position(trajectory.end_ns) == pytest.approx(goal, rel=0.0, abs=1e-18)
    assert all(move(first, one, speed, acceleration, 10.0) == [] for one in (start, math.nextafter(start, 2.0)))
    # A cruise of some nanoseconds, of which the rounded times say little.
    edge = min(start + speed * speed / acceleration + speed * excess, 1.5)
    LIMITS.check(Trajectory([first, *trapezoid(first, edge, speed, acceleration)]))


def test_the_limits_hold_the_described_strokes_and_the_guide():
    motion = MotionParameters(start=-0.5, stroke=1.0, speed=0.3, acceleration=0.2, highest_speed=2.0)
    assert StageLimits.of(motion, -0.1, 0.9) == StageLimits(-0.5, 0.9, 2.0, 2.0)
    StageLimits.of(motion, 0.0, 0.0).check(Trajectory(cycles(motion, 1000)))


@given(st.floats(1e-4, 1.4), st.floats(0.001, 4 / 3), st.floats(0.01, 2.0), st.floats(1e-3, 0.1), st.booleans())
@example(1.0, 0.001953125, 0.99609375, 0.001953125, False)  # the whole acceleration lasts 8 µs
def test_an_s_curve_keeps_speed_acceleration_and_jerk_and_arrives_at_rest(distance, speed, acceleration, build, back):
    goal = -distance if back else distance
    first, limits = Waypoint(7, 0.0, 0.0), StageLimits(-1.5, 1.5, speed * 1.001, acceleration * 1.001)
    trajectory = Trajectory([first, *move(first, goal, speed, acceleration, acceleration / build)])
    limits.check(trajectory)
    assert trajectory.position(trajectory.end_ns) == goal
    # Between the corners the acceleration is a straight line, and it has no steps.
    inner = trajectory.times[1:-1].tolist()
    steps = [trajectory.rates(at)[1] - trajectory.rates(at - 1e-3)[1] for at in inner]
    h = np.diff(trajectory.times) * 1e-9
    noise = 1e-8 * speed / h**2  # of times rounded to 1 ns
    assert np.abs(steps).max() < 1e-3 * acceleration + 2.0 * noise.max()
    slopes = [trajectory.rates(after - 1e-3)[1] - trajectory.rates(before)[1] for before, after in pairwise(inner)]
    assert (np.abs(slopes) < (1.001 * acceleration / build * h + 2.0 * noise)[1:-1]).all()


def test_a_cycle_goes_to_equal_steps_or_to_the_positions_of_a_file_and_back_to_its_start(tmp_path, monkeypatch):
    steps = MotionParameters(start=0.1, stroke=-0.09, steps=3)
    assert goals(steps) == pytest.approx([0.07, 0.04, 0.01, 0.1])
    cycle = Trajectory(forward_and_back(steps))
    rests = [point.position for point in cycle.waypoints if point.velocity == 0.0]
    assert rests == pytest.approx([0.1, 0.1, 0.07, 0.07, 0.04, 0.04, 0.01, 0.01, 0.1, 0.1])
    file = tmp_path / "positions.txt"
    file.write_text("0.2  # first\n\n-0.01\n", encoding="utf-8-sig")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in (str(file), "~/positions.txt"):
        assert goals(MotionParameters(file=name)) == [0.2, -0.01, 0.0]
    for text, words in (("", "0 positions; allowed: 1 to 1000"), ("0.1\nzwei", "line 2: 'zwei'"), ("nan", "line 1")):
        file.write_text(text)
        with pytest.raises(ParameterError, match=f"stage.motion.file.*{words}"):
            goals(MotionParameters(file=str(file)))
    with pytest.raises(ParameterError, match=r"nowhere.*cannot be read"):
        goals(MotionParameters(file="nowhere"))
    with pytest.raises(ParameterError, match="stroke"):
        MotionParameters(stroke=0.0)
