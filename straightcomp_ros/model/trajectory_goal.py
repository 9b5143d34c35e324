"""A goal to follow a trajectory, as of control_msgs/action/FollowJointTrajectory: what it asks for, and how it ends.

Zero for a tolerance means the default of :class:`Tolerances`, a negative number that there is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.model.paced_motion import ARRIVED_M, PacedMotion

SUCCESSFUL, INVALID_GOAL, INVALID_JOINTS, OLD_HEADER_TIMESTAMP = 0, -1, -2, -3
PATH_TOLERANCE_VIOLATED, GOAL_TOLERANCE_VIOLATED = -4, -5
"""Error codes of the action's result."""


class GoalRefused(ValueError):
    """A goal is refused for the reason in the message; ``code`` is that of the result."""

    def __init__(self, reason: str, code: int = INVALID_GOAL) -> None:
        super().__init__(reason)
        self.code = code


class Outcome(NamedTuple):
    """How a goal ended: ``succeed``, ``canceled`` or ``abort``, as rclpy's goal handles have it; its result; whether
    its motion is to be ended."""

    how: str
    code: int
    text: str
    end: bool = False


@dataclass(frozen=True)
class Tolerances:
    """Largest distance in m from the trajectory on the way, and at its end, there at the latest after ``time`` s. The
    defaults of the end are the cell's."""

    path: float = math.inf
    goal: float = ARRIVED_M
    time: float = 5.0

    @classmethod
    def of(cls, request: Any, joint: str) -> Tolerances:
        """Those of a goal's message; GoalRefused for what is not checked here."""
        found = {}
        for name in ("path", "goal"):
            field = f"{name}_tolerance"
            if len(getattr(request, f"component_{field}")):
                raise GoalRefused(f"component_{field}: joints of several axes are not moved here")
            for one in getattr(request, field):
                if one.name != joint or max(one.velocity, one.acceleration) > 0.0 or math.isnan(one.position):
                    raise GoalRefused(f"{field} of '{one.name}'; allowed: the position of '{joint}' alone")
                found[name] = _chosen(one.position, getattr(cls, name))
        lasts = request.goal_time_tolerance
        return cls(**found, time=_chosen(lasts.sec + lasts.nanosec * 1e-9, cls.time))


def _chosen(value: float, default: float) -> float:
    return value if value > 0.0 else math.inf if value < 0.0 else default


def check_joints(request: Any, joint: str) -> None:
    """GoalRefused if a goal's message is not of ``joint``."""
    names, more = list(request.trajectory.joint_names), list(request.multi_dof_trajectory.joint_names)
    if joint not in names or more:
        raise GoalRefused(f"joints {str(names + more)[:200]}; allowed: '{joint}'", INVALID_JOINTS)


def begins_after(stamp_ns: int, lasts_ns: int, now_ns: int) -> int:
    """Time in ns from ``now_ns`` until a trajectory of ``lasts_ns`` begins by its stamp; 0 if it has none, or began
    lately. GoalRefused: its time is over."""
    if not stamp_ns:
        return 0
    over_ns = now_ns - stamp_ns - lasts_ns
    if over_ns > 0:
        raise GoalRefused(f"the trajectory ended {over_ns * 1e-9:.3f} s ago by its stamp", OLD_HEADER_TIMESTAMP)
    return max(0, stamp_ns - now_ns)


class TrajectoryGoal:
    """A goal whose trajectory ``motion`` has just begun; ``fault`` is what was latched then, empty without.

    Attributes:
        canceled: whether the goal is to end as canceled as soon as the stage stands; the caller ends its motion.
    """

    def __init__(self, trajectory: Trajectory, tolerances: Tolerances, motion: PacedMotion, fault: str) -> None:
        self._end, self._tolerances = float(trajectory.positions[-1]), tolerances
        self._number, self._fault = motion.number, fault
        self._over_ns: int | None = None
        self.canceled = False

    def look(
        self, now_ns: int, x: float, desired: float, motion: PacedMotion, over: bool, fault: str
    ) -> Outcome | None:
        """How the goal has ended, if it has; call it often.

        Args:
            now_ns: a clock that does not go back.
            x, desired: of the newest sample, and where the stage was to be then, m.
            motion: of the stage; it is ``over``.
            fault: that is latched now; empty without one.
        """
        if motion.number != self._number:
            return Outcome("abort", INVALID_GOAL, "another motion of the stage has taken the place of this one")
        if fault and fault != self._fault:
            return Outcome("abort", INVALID_GOAL, f"a fault switched the amplifier off: {fault}", end=True)
        self._fault = fault
        where = f"the stage is at {x:.6f} m"
        if abs(x - desired) > self._tolerances.path:
            off = f"{where}, {(x - desired) * 1e3:+.3f} mm from its trajectory"
            allowed = f"{off}; allowed: ±{self._tolerances.path * 1e3:g} mm"
            return Outcome("abort", PATH_TOLERANCE_VIOLATED, allowed, end=True)
        if not over:
            return None
        if self.canceled:
            return Outcome("canceled", SUCCESSFUL, f"canceled: {where}")
        if motion.ended and abs(desired - self._end) > min(self._tolerances.goal, Tolerances.goal):
            return Outcome("abort", INVALID_GOAL, f"the motion was ended on its way: {where}")
        allowed_m = self._tolerances.goal + motion.half_count
        if abs(x - self._end) <= allowed_m:
            return Outcome("succeed", SUCCESSFUL, where)
        self._over_ns = self._over_ns or now_ns
        if now_ns - self._over_ns <= self._tolerances.time * 1e9:
            return None
        off = f"{where}, {(x - self._end) * 1e6:+.1f} µm from its goal"
        return Outcome("abort", GOAL_TOLERANCE_VIOLATED, f"{off}; allowed: ±{allowed_m * 1e6:g} µm")
