"""A motion that is held, slowed down, let go on and ended: within the stage's limits, and on its trajectory."""

import random

import numpy as np
import pytest

from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, cycles, forward_and_back, jog
from straightcomp_ros.model.paced_motion import Pace, PacedMotion

T_NS = 500_000
HOLD = Pace(hold=True)


def positions(motion, paces, lasts=10**6):
    """Positions of a stage at the sampling rate until its motion is over; ``paces`` by sample."""
    found = []
    while not motion.over and len(found) < lasts:
        found.append(motion.position(len(found) * T_NS))
        if len(found) - 1 in paces:
            motion.ask(paces[len(found) - 1])
    return np.array(found)


def begun(parameters, count=1):
    motion = PacedMotion(parameters, parameters.start)
    motion.begin(Trajectory(cycles(parameters, count)), 0)
    return motion


def test_a_motion_that_nobody_slows_down_is_its_trajectory_to_the_bit():
    parameters = MotionParameters(stroke=0.05)
    trajectory = Trajectory(forward_and_back(parameters))
    x = positions(begun(parameters), {7: Pace()})
    assert x.tolist() == [trajectory.position(k * T_NS) for k in range(x.size)]


@pytest.mark.parametrize("seed", range(8))
def test_whatever_is_asked_the_stage_keeps_its_limits_stands_in_time_and_arrives(seed):
    draw = random.Random(seed)
    speed, acceleration = draw.choice([0.01, 0.3, 1.0]), draw.choice([0.2, 2.0])
    build = 0.01
    parameters = MotionParameters(
        stroke=draw.choice([1e-4, 0.002, -0.05, 0.3]),
        speed=speed,
        acceleration=acceleration,
        jerk=acceleration / build,
        settle=0.05,
        pause=draw.choice([0.0, 0.05]),
    )
    motion, steps, paces = begun(parameters, 2), 0, {}
    for _ in range(6):
        steps += draw.randrange(1, 1500)
        paces[steps] = draw.choice([HOLD, Pace(), Pace(0.3), Pace(draw.random())])
    paces[steps + 3000] = Pace()
    x = positions(motion, paces)
    assert x[-1] == pytest.approx(parameters.start, abs=1e-9) and not motion.cut
    v = np.diff(x) / (T_NS * 1e-9)
    a = np.diff(v) / (T_NS * 1e-9)
    assert np.abs(v).max() < 1.001 * speed and np.abs(a).max() < 1.05 * acceleration
    # Three times the jerk is the most that two motions, one of them of the pace, add up to.
    assert np.abs(np.diff(a)).max() < 3.0 * parameters.jerk * T_NS * 1e-9
    for at in (at for at, pace in paces.items() if pace.hold and at < v.size):
        allowed = round((abs(v[at - 1]) / acceleration + 2.5 * build) / (T_NS * 1e-9))
        if not any(at < other < at + allowed for other in paces) and at + allowed < v.size:
            assert abs(v[at + allowed]) < 1e-6


def test_override_scales_the_speed_and_a_preset_one_holds_from_the_start():
    parameters = MotionParameters(stroke=0.3)
    motion = PacedMotion(parameters)
    motion.ask(Pace(0.3))
    motion.begin(Trajectory(forward_and_back(parameters)), 0)
    x = positions(motion, {})
    full = Trajectory(forward_and_back(parameters))
    assert x.size == pytest.approx(full.end_ns / 0.3 / T_NS, abs=2)
    assert [full.position(0.3 * k * T_NS) for k in range(0, x.size, 500)] == pytest.approx(x[::500], abs=1e-9)


def test_a_motion_that_is_ended_stands_where_it_came_to_rest_and_the_next_begins_there():
    parameters = MotionParameters(stroke=0.3)
    motion = begun(parameters)
    x = positions(motion, {3200: Pace(0.5, end=True)})
    assert motion.condition == "rest" and 0.05 < x[-1] < 0.1 and not motion.cut
    now_ns = x.size * T_NS
    with pytest.raises(ValueError, match="stands at"):
        motion.begin(Trajectory(forward_and_back(parameters)), now_ns)
    here = motion.position(now_ns)
    motion.begin(Trajectory(jog(parameters, here, -1e-4)), now_ns)
    assert motion.pace == Pace(0.5) and motion.position(now_ns + 10**9) == pytest.approx(here - 1e-4, abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_a_trajectory_whose_first_point_comes_later_goes_on_at_the_speed_and_pace_that_the_stage_has(seed):
    draw = random.Random(seed)
    parameters = MotionParameters(stroke=0.3, settle=0.05)
    motion, at = begun(parameters), draw.randrange(200, 2500)
    x = positions(motion, {at - 150: draw.choice([HOLD, Pace(), Pace(0.3), Pace(end=True)])}, at)
    goal = Trajectory([Waypoint(4 * 10**9, draw.uniform(0.0, 0.3), 0.0)])
    joined = motion.joined(goal, at * T_NS)
    motion.begin(goal, at * T_NS)
    motion.ask(Pace())
    assert motion.number == 2 and motion.cut
    rest = [motion.position(k * T_NS) for k in range(at, at + 60_000)]
    assert motion.over and not motion.cut and rest[-1] == goal.positions[-1]
    a = np.diff(np.concatenate([x, rest]), 2) / (T_NS * 1e-9) ** 2
    assert np.abs(a).max() < 1.05 * max(parameters.acceleration, joined.largest_acceleration)


@pytest.mark.parametrize("at", [500, 1800])
def test_a_goal_that_takes_the_place_of_a_motion_joins_its_acceleration(at):
    parameters = MotionParameters(stroke=0.3, settle=0.05, jerk=20.0)
    motion = begun(parameters)
    x = positions(motion, {}, at)
    assert abs(x[-1] - 2.0 * x[-2] + x[-3]) > 0.9 * 0.2 * (T_NS * 1e-9) ** 2
    motion.begin(Trajectory([Waypoint(4 * 10**9, 0.02, 0.0)]), at * T_NS)
    x = np.concatenate([x, [motion.position(k * T_NS) for k in range(at, at + 9000)]])
    a = np.diff(x, 2) / (T_NS * 1e-9) ** 2
    assert x[-1] == 0.02 and np.abs(np.diff(a)).max() < 1.1 * parameters.jerk * T_NS * 1e-9


def test_a_trajectory_is_joined_where_x_reads_from_another_zero():
    motion = begun(MotionParameters(stroke=0.3))
    here = motion.position(2 * 10**9)
    first, *_ = motion.joined(Trajectory([Waypoint(10**9, 0.0, 0.0)]), 2 * 10**9, zero=0.01).waypoints
    assert first == pytest.approx((0, here - 0.01, 0.2 * (2.0 - 1.0)))


def test_what_the_stage_does_is_said_and_a_moving_stage_takes_no_other_motion():
    motion = begun(MotionParameters(stroke=0.3))
    motion.position(2 * 10**9)
    assert motion.condition == "moving" and motion.moving and not motion.cut
    with pytest.raises(ValueError, match="stage is moving"):
        motion.begin(Trajectory(jog(MotionParameters(), motion.position(2 * 10**9), 0.1)), 2 * 10**9)
    motion.ask(HOLD)
    assert motion.condition == "stopping" and motion.cut
    motion.position(5 * 10**9)
    assert motion.condition == "held" and motion.behind_ns > 10**9
    motion.ask(Pace())
    assert motion.condition == "moving" and motion.cut
