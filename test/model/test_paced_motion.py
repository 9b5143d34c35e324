"""A motion that is held, slowed down, let go on and ended, within the stage's limits and on its trajectory; and goals
of FollowJointTrajectory: accepted or refused in a sentence, watched while the stage moves, and ended."""

import math
import random
from types import SimpleNamespace

import numpy as np
import pytest

from straightcomp_ros.model import trajectory_goal as goals
from straightcomp_ros.model.motion import MotionParameters, Trajectory, Waypoint, cycles, forward_and_back, jog
from straightcomp_ros.model.paced_motion import Pace, PacedMotion, StageState
from straightcomp_ros.model.trajectory_goal import (
    GoalRefused,
    Outcome,
    Tolerances,
    TrajectoryGoal,
    begins_after,
    check_joints,
)

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
    speed, acceleration, build = draw.choice([0.01, 0.3, 1.0]), draw.choice([0.2, 2.0]), 0.01
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


@pytest.mark.parametrize("acceleration", [0.2, 2.0])
def test_a_stage_without_a_limit_of_the_jerk_stands_some_10_ms_after_its_speed_over_its_acceleration(acceleration):
    parameters = MotionParameters(stroke=0.6, settle=0.0, acceleration=acceleration)
    motion = begun(parameters)
    at = round((0.3 / acceleration + 0.1) / (T_NS * 1e-9))
    v = np.diff(positions(motion, {at: HOLD}, at + 4000)) / (T_NS * 1e-9)
    assert 0.01 < (np.flatnonzero(v)[-1] - at) * T_NS * 1e-9 - 0.3 / acceleration < 0.02


@pytest.mark.parametrize("override", [0.0, 0.3, 0.7])
def test_the_pace_goes_to_what_is_asked_for_and_not_past_it_however_rarely_the_stage_is_looked_at(override):
    often, rarely = (begun(MotionParameters(stroke=1.7, settle=0.0, acceleration=2.0, jerk=200.0)) for _ in range(2))
    paces, found = {2000: Pace(override), 4000: Pace(), 6001: Pace(override)}, []
    for k in range(8000):
        found.append((often.position(k * T_NS), often._u))
        if k % 7 == 0 or k in paces:
            assert (rarely.position(k * T_NS), rarely._u) == found[-1]
        for motion in (often, rarely):
            if k in paces:
                motion.ask(paces[k])
    u = np.array(found)[:, 1]
    down, up, again = (np.diff(u[first : first + 1999]) for first in paces)
    assert (down <= 0.0).all() and (up >= 0.0).all() and (again <= 0.0).all() and u[3999] == u[-1] == override


@pytest.mark.parametrize("count", [1e-7, 5e-6, 1e-3])
def test_a_motion_may_begin_where_the_encoder_reads_the_stage_to_be_and_nowhere_else(count):
    parameters, x = MotionParameters(), 0.30049
    motion, reading = PacedMotion(parameters, x, count), count * round(x / count)
    for elsewhere in (reading + 2.0 * count, reading - 2.0 * count):
        if abs(elsewhere - x) > 1e-6:
            with pytest.raises(ValueError, match="starts at"):
                motion.begin(Trajectory(jog(parameters, elsewhere, 0.1)), 0)
    motion.begin(Trajectory(jog(parameters, reading, 0.1)), 0)
    assert motion.position(10**10) == reading + 0.1


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
    assert motion.condition == "rest" and 0.05 < x[-1] < 0.1 and motion.ended and not motion.cut
    now_ns = x.size * T_NS
    with pytest.raises(ValueError, match="stands at"):
        motion.begin(Trajectory(forward_and_back(parameters)), now_ns)
    here = motion.position(now_ns)
    motion.begin(Trajectory(jog(parameters, here, -1e-4)), now_ns)
    assert motion.pace == Pace(0.5) and motion.position(now_ns + 10**9) == pytest.approx(here - 1e-4, abs=1e-12)
    motion.ask(Pace(end=True))
    assert motion.over and not motion.ended


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
    with pytest.raises(ValueError, match=r"starts at 0\.4 m/s, but the stage moves at 0 m/s"):
        PacedMotion(MotionParameters()).begin(Trajectory([Waypoint(0, 0.0, 0.4), Waypoint(10**9, 0.2, 0.0)]), 0)
    assert PacedMotion(MotionParameters()).state() == StageState()
    motion = begun(MotionParameters(stroke=0.3))
    motion.position(2 * 10**9)
    assert motion.condition == "moving" and motion.moving and not motion.cut
    with pytest.raises(ValueError, match=r"the stage moves at 0\.\d+ m/s; end its motion"):
        motion.begin(Trajectory(jog(MotionParameters(), motion.position(2 * 10**9), 0.1)), 2 * 10**9)
    motion.ask(HOLD)
    assert motion.condition == "stopping" and motion.cut
    motion.position(5 * 10**9)
    assert motion.condition == "held" and motion.behind_ns > 10**9
    assert motion.state(10**12) == StageState("held", 1.0, motion.behind_ns, cut=True, number=1, ended=False)
    motion.ask(Pace(0.5))
    assert motion.condition == "moving" and motion.cut
    motion.position(51 * 10**8)
    # In lockstep no sample comes after the one whose period the motion ends in.
    assert motion.state().condition == "moving" and motion.state(10**12) == StageState("rest", 0.5, 0, True, 1)


STEP_NS = 50_000_000
DEFAULTS = Tolerances()


def duration(seconds):
    sec, nanosec = divmod(round(seconds * 1e9), 10**9)
    return SimpleNamespace(sec=sec, nanosec=nanosec)


def tolerance(name="stage_x", position=0.0, velocity=0.0, acceleration=0.0):
    return SimpleNamespace(name=name, position=position, velocity=velocity, acceleration=acceleration)


def request(joints=("stage_x",), path=(), goal=(), time=0.0, **more):
    """What a goal's message has, as far as it is looked at."""
    fields = {
        "trajectory": SimpleNamespace(joint_names=list(joints)),
        "multi_dof_trajectory": SimpleNamespace(joint_names=[]),
        "path_tolerance": list(path),
        "goal_tolerance": list(goal),
        "component_path_tolerance": [],
        "component_goal_tolerance": [],
        "goal_time_tolerance": duration(time),
    }
    return SimpleNamespace(**(fields | more))


def followed(paces=None, tolerances=DEFAULTS, shift=lambda at_ns: 0.0, fault=lambda at_ns: "", cancel_ns=None):
    """Outcome of a jog by 100 mm, and how long it took in s; ``shift`` is the sample's distance from the trajectory."""
    parameters = MotionParameters(speed=0.1)
    motion, trajectory = PacedMotion(parameters), Trajectory(jog(parameters, 0.0, 0.1))
    motion.begin(trajectory, 0)
    goal = TrajectoryGoal(trajectory, tolerances, motion, fault(0))
    for at_ns in range(0, 20 * 10**9, STEP_NS):
        desired = motion.position(at_ns)
        if at_ns in (paces or {}):
            motion.ask(paces[at_ns])
        if at_ns == cancel_ns:
            goal.canceled = True
            motion.ask(Pace(end=True))
        outcome = goal.look(at_ns, desired + shift(at_ns), desired, motion, motion.over, fault(at_ns))
        if outcome:
            return outcome, at_ns * 1e-9, motion
    return None, 20.0, motion


def test_a_goal_succeeds_when_the_stage_is_at_its_end_also_after_a_hold():
    outcome, seconds, _ = followed()
    assert outcome == Outcome("succeed", goals.SUCCESSFUL, "the stage is at 0.100000 m") and seconds < 1.6
    held, later, _ = followed({STEP_NS * 5: Pace(hold=True), STEP_NS * 50: Pace()})
    assert held == outcome and later > seconds + 2.0


def test_a_canceled_goal_ends_when_the_stage_stands_short_of_its_end():
    outcome, seconds, motion = followed(cancel_ns=10 * STEP_NS)
    assert outcome.how == "canceled" and outcome.code == 0 and 0.9 < seconds < 1.2
    assert motion.condition == "rest" and 0.025 < motion.position(0) < 0.06


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ({"shift": lambda at_ns: 2e-3, "tolerances": Tolerances(path=1e-3)}, -4, "2.000 mm from its trajectory"),
        ({"shift": lambda at_ns: 1e-4, "tolerances": Tolerances(time=0.2)}, -5, "+100.0 µm from its goal"),
        ({"paces": {10 * STEP_NS: Pace(end=True)}}, -1, "ended on its way"),
        ({"paces": {10 * STEP_NS: Pace(end=True)}, "tolerances": Tolerances(goal=math.inf)}, -1, "ended on its way"),
        ({"fault": lambda at_ns: "tripped: door" if at_ns > 10**8 else ""}, -1, "tripped: door"),
    ],
    ids=["path", "goal", "ended", "ended, any goal", "fault"],
)
def test_what_goes_wrong_aborts_a_goal_with_its_code_and_a_sentence(options, code, words):
    outcome, _, _ = followed(**options)
    assert outcome.how == "abort" and outcome.code == code and words in outcome.text
    # The others have no motion any more.
    assert outcome.end is ("fault" in options or code == -4)


def test_a_fault_that_was_latched_before_does_not_abort_a_goal_and_the_end_may_come_late():
    assert followed(fault=lambda at_ns: "tripped: door")[0].how == "succeed"
    outcome, seconds, _ = followed(shift=lambda at_ns: 1e-4 if at_ns < 3 * 10**9 else 0.0)
    assert outcome.how == "succeed" and seconds == 3.0


def test_another_motion_takes_the_place_of_a_goal():
    motion, trajectory = PacedMotion(MotionParameters()), Trajectory(jog(MotionParameters(), 0.0, 0.05))
    motion.begin(trajectory, 0)
    goal = TrajectoryGoal(trajectory, Tolerances(), motion, "")
    motion.number += 1
    outcome = goal.look(0, 0.0, 0.0, motion, False, "")
    assert "another motion" in outcome.text and not outcome.end


@pytest.mark.parametrize(("x", "how"), [(0.050049, "succeed"), (0.050061, "abort")])
def test_a_goal_between_two_counts_is_reached_where_the_reading_is_half_a_count_off(x, how):
    motion, trajectory = PacedMotion(MotionParameters(), count=1e-4), Trajectory(jog(MotionParameters(), 0.0, 0.05))
    motion.begin(trajectory, 0)
    goal = TrajectoryGoal(trajectory, Tolerances(time=0.0), motion, "")
    outcomes = [goal.look(at_ns, x, 0.05, motion, True, "") for at_ns in (10**10, 10**10 + 1)]
    outcome = next(filter(None, outcomes))
    assert outcome.how == how and (how == "succeed" or "allowed: ±60 µm" in outcome.text)


def test_zero_is_the_default_of_a_tolerance_and_a_negative_one_is_none():
    assert Tolerances.of(request(path=[tolerance()], goal=[tolerance()]), "stage_x") == Tolerances()
    asked = request(path=[tolerance(position=1e-3)], goal=[tolerance(position=-1.0)], time=2.5)
    assert Tolerances.of(asked, "stage_x") == Tolerances(1e-3, float("inf"), 2.5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"path": [tolerance(velocity=0.1)]},
        {"goal": [tolerance(acceleration=0.1)]},
        {"goal": [tolerance("arm", 1.0)]},
        {"goal": [tolerance(position=float("nan"))]},
        {"component_path_tolerance": [1]},
    ],
)
def test_a_tolerance_that_is_not_checked_is_refused(wrong):
    with pytest.raises(GoalRefused, match="tolerance"):
        Tolerances.of(request(**wrong), "stage_x")


def test_a_trajectory_begins_by_its_stamp_and_one_that_is_over_or_of_another_joint_is_refused_with_its_code():
    now_ns, lasts_ns = 100 * 10**9, 2 * 10**9
    assert begins_after(0, lasts_ns, now_ns) == begins_after(99 * 10**9, lasts_ns, now_ns) == 0
    assert begins_after(100_500_000_000, lasts_ns, now_ns) == 500_000_000
    for refuse, code in (
        (lambda: begins_after(97 * 10**9, lasts_ns, now_ns), -3),
        (lambda: check_joints(request(joints=["arm"]), "stage_x"), -2),
    ):
        with pytest.raises(GoalRefused) as refused:
            refuse()
        assert refused.value.code == code
    check_joints(request(), "stage_x")
