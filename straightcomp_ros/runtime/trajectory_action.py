"""The action control_msgs/action/FollowJointTrajectory, which ROS users expect of what moves a joint.

PyPI has no wheel of control_msgs, so the action is offered where an installed Jazzy has it. A refused goal is accepted
and aborted at once: the protocol has no room for a reason in the refusal itself, and its result has.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.serialization import serialize_message

from straightcomp_ros.contract import STAGE
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.messages.joint_trajectory import read_trajectory
from straightcomp_ros.model.motion import Trajectory
from straightcomp_ros.model.trajectory_goal import (
    INVALID_GOAL,
    Outcome,
    Tolerances,
    TrajectoryGoal,
    begins_after,
    check_joints,
)
from straightcomp_ros.runtime.guarded_node import ThrottledWarning
from straightcomp_ros.runtime.inside_rclpy import execute, set_executing

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:
    FollowJointTrajectory = None


def read_by_stamp(message: bytes) -> Trajectory:
    """The stage's trajectory in a JointTrajectory, from now on: by its stamp it may begin later. ValueError if it
    cannot be read, or its time is over."""
    stamp_ns, (times, *rest) = read_trajectory(message, STAGE)
    # A stamp is of the system's clock, as other programs read it now, not of the one that never steps.
    return Trajectory.from_columns(times + begins_after(stamp_ns, int(times.max(initial=0)), time.time_ns()), *rest)


class TrajectoryAction:
    """The action ``~/follow_joint_trajectory`` of ``node``, for the stage; nothing where control_msgs is not installed.

    ``begin`` starts a trajectory with its tolerances and returns what is followed; ValueError or HardwareError if it is
    refused. ``end`` lets the stage come to rest within its limits; HardwareError if it cannot.

    Attributes:
        goal: the one that is followed now.
    """

    def __init__(
        self,
        node: Any,
        begin: Callable[[Trajectory, Tolerances], TrajectoryGoal],
        end: Callable[[], object],
    ) -> None:
        self._node, self._begin, self._end = node, begin, end
        self._refused = ThrottledWarning(node, "a goal is refused")
        self.goal: TrajectoryGoal | None = None
        self._handle: Any = None
        self._server: Any = None
        if FollowJointTrajectory is not None:
            self._server = ActionServer(
                node,
                FollowJointTrajectory,
                "~/follow_joint_trajectory",
                self._unused,
                handle_accepted_callback=self._take,
                cancel_callback=self._cancel,
            )

    def _unused(self, handle: Any) -> Any:
        raise NotImplementedError

    def _take(self, handle: Any) -> None:
        set_executing(handle)
        request = handle.request
        try:
            check_joints(request, STAGE)
            tolerances = Tolerances.of(request, STAGE)
            goal = self._begin(read_by_stamp(serialize_message(request.trajectory)), tolerances)
        except (ValueError, HardwareError) as error:
            self._refused.log(error)
            self._answer(handle, Outcome("abort", getattr(error, "code", INVALID_GOAL), f"refused: {error}"))
            return
        self.abandon("another goal has taken its place")
        self.goal, self._handle = goal, handle

    def _cancel(self, handle: Any) -> CancelResponse:
        if self.goal is None or handle != self._handle or not self._ends():
            return CancelResponse.REJECT
        self.goal.canceled = True
        return CancelResponse.ACCEPT

    def _ends(self) -> bool:
        """Let the stage come to rest; False if that does not reach it: a bus may be gone, also by the fault itself."""
        try:
            self._end()
        except HardwareError as error:
            self._node.get_logger().warning(f"the motion of a goal goes on: {error}")
            return False
        return True

    def report(self, outcome: Outcome | None, x: float, desired: float) -> None:
        """Publish where the stage is and was to be, m, and how the goal has ended, if it has."""
        handle, feedback = self._handle, FollowJointTrajectory.Feedback()
        feedback.header.stamp = self._node.get_clock().now().to_msg()
        feedback.joint_names = [STAGE]
        feedback.desired.positions, feedback.actual.positions = [desired], [x]
        feedback.error.positions = [desired - x]
        handle.publish_feedback(feedback)
        if outcome is None:
            return
        self.goal = self._handle = None
        if outcome.end:
            self._ends()
        self._finish(handle, outcome)

    def abandon(self, reason: str) -> None:
        """Abort the goal that is followed, if any; the stage is left as it is."""
        if self.goal is not None:
            handle, self.goal, self._handle = self._handle, None, None
            self._finish(handle, Outcome("abort", INVALID_GOAL, reason))

    def close(self) -> None:
        """Withdraw the action; it is destroyed when the executor has dropped it too."""
        if self._server is not None:
            self._node.remove_waitable(self._server)
            self._server = None

    def _finish(self, handle: Any, outcome: Outcome) -> None:
        self._node.get_logger().info(f"goal: {outcome.how}, {outcome.text}")
        self._answer(handle, outcome)

    def _answer(self, handle: Any, outcome: Outcome) -> None:
        def finished(handle: Any) -> Any:
            getattr(handle, outcome.how)()
            return FollowJointTrajectory.Result(error_code=outcome.code, error_string=outcome.text)

        execute(self._server, self._node, handle, finished)
