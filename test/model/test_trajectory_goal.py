"""A goal of FollowJointTrajectory: accepted or refused in a sentence, watched while the stage moves, and ended."""

from types import SimpleNamespace

import pytest

from straightcomp_ros.model import trajectory_goal as goals
from straightcomp_ros.model.motion import MotionParameters, Trajectory, jog
from straightcomp_ros.model.paced_motion import Pace, PacedMotion
from straightcomp_ros.model.trajectory_goal import GoalRefused, Outcome, Tolerances, TrajectoryGoal, begins_after

STEP_NS = 50_000_000
DEFAULTS = Tolerances()


def duration(seconds):
    sec, nanosec = divmod(round(seconds * 1e9), 10**9)
    return SimpleNamespace(sec=sec, nanosec=nanosec)


def tolerance(name="stage_x", position=0.0, velocity=0.0, acceleration=0.0):
    return SimpleNamespace(name=name, position=position, velocity=velocity, acceleration=acceleration)


def request(joints=("stage_x",), stamp=0.0, lasts=2.0, path=(), goal=(), time=0.0, **more):
    """What a goal's message has, as far as it is looked at."""
    trajectory = SimpleNamespace(
        header=SimpleNamespace(stamp=duration(stamp)),
        joint_names=list(joints),
        points=[SimpleNamespace(time_from_start=duration(lasts))],
    )
    fields = {
        "trajectory": trajectory,
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
        ({"fault": lambda at_ns: "tripped: door" if at_ns > 10**8 else ""}, -1, "tripped: door"),
    ],
    ids=["path", "goal", "ended", "fault"],
)
def test_what_goes_wrong_aborts_a_goal_with_its_code_and_a_sentence(options, code, words):
    outcome, _, _ = followed(**options)
    assert outcome.how == "abort" and outcome.code == code and words in outcome.text


def test_a_fault_that_was_latched_before_does_not_abort_a_goal_and_the_end_may_come_late():
    assert followed(fault=lambda at_ns: "tripped: door")[0].how == "succeed"
    outcome, seconds, _ = followed(shift=lambda at_ns: 1e-4 if at_ns < 3 * 10**9 else 0.0)
    assert outcome.how == "succeed" and seconds == 3.0


def test_another_motion_takes_the_place_of_a_goal():
    motion, trajectory = PacedMotion(MotionParameters()), Trajectory(jog(MotionParameters(), 0.0, 0.05))
    motion.begin(trajectory, 0)
    goal = TrajectoryGoal(trajectory, Tolerances(), motion, "")
    motion.number += 1
    assert "another motion" in goal.look(0, 0.0, 0.0, motion, False, "").text


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


def test_a_goal_begins_by_its_stamp_and_one_that_is_over_or_of_another_joint_is_refused_with_its_code():
    now_ns = 100 * 10**9
    assert begins_after(request(), "stage_x", now_ns) == begins_after(request(stamp=99.0), "stage_x", now_ns) == 0
    assert begins_after(request(stamp=100.5), "stage_x", now_ns) == 500_000_000
    for wrong, code in ((request(stamp=97.0), -3), (request(joints=["arm"]), -2)):
        with pytest.raises(GoalRefused) as refused:
            begins_after(wrong, "stage_x", now_ns)
        assert refused.value.code == code
