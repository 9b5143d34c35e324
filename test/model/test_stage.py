import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightcomp_ros.model.stage import MotionParameters, Trajectory, Waypoint, forward_and_back, trapezoid

MOTION = MotionParameters()
CYCLE = Trajectory(forward_and_back(MOTION))


def test_a_cycle_takes_the_time_of_its_two_trapezoids_and_rests():
    ramp = MOTION.speed / MOTION.acceleration
    stroke = 2 * ramp + (MOTION.stroke - MOTION.speed * ramp) / MOTION.speed
    assert CYCLE.end_ns * 1e-9 == pytest.approx(2 * stroke + MOTION.pause + 2 * MOTION.settle, abs=1e-8)


def test_between_corners_the_motion_is_the_exact_parabola():
    for t in (0.1, 0.7, 1.4):
        at = round((MOTION.settle + t) * 1e9)
        assert CYCLE.position(at) == pytest.approx(0.5 * MOTION.acceleration * t * t, abs=1e-9)


def test_the_stage_goes_to_the_far_end_and_comes_back():
    far = max(CYCLE.position(t) for t in range(0, CYCLE.end_ns, 1_000_000))
    assert far == pytest.approx(MOTION.stroke, abs=1e-12)
    assert CYCLE.position(CYCLE.end_ns + 1) == CYCLE.position(-1) == 0.0


def test_speed_and_acceleration_keep_their_limits():
    h = 10_000_000
    x = [CYCLE.position(t) for t in range(0, CYCLE.end_ns, h)]
    v = [(b - a) / 0.01 for a, b in itertools.pairwise(x)]
    a = [(d - c) / 0.01 for c, d in itertools.pairwise(v)]
    assert max(map(abs, v)) <= MOTION.speed * (1 + 1e-9)
    assert max(map(abs, a)) <= MOTION.acceleration * (1 + 1e-6)


@given(st.floats(1e-4, 2.0), st.floats(0.01, 1.0), st.floats(0.05, 5.0), st.booleans())
def test_a_trapezoid_ends_at_rest_at_its_goal(distance, speed, acceleration, backward):
    goal = -distance if backward else distance
    points = trapezoid(Waypoint(0, 0.0, 0.0), goal, speed, acceleration)
    assert points[-1].position == goal and points[-1].velocity == 0.0
    trajectory = Trajectory([Waypoint(0, 0.0, 0.0), *points])
    assert trajectory.position(points[-1].time_ns) == goal


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "no points"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(0, 1.0, 0.0)], "point 1.*not after"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(1, float("nan"), 0.0)], "point 1.*not finite"),
        ([Waypoint(0, 0.0, 0.0), Waypoint(10, 1.0, 0.5)], "end at rest"),
    ],
)
def test_a_bad_trajectory_is_refused_with_its_point(points, words):
    with pytest.raises(ValueError, match=words):
        Trajectory(points)
