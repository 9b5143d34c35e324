"""The stage's trajectory as a trajectory_msgs/JointTrajectory."""

from collections.abc import Sequence

from builtin_interfaces.msg import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from straightcomp_ros.contract import STAGE
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.model.motion import Waypoint


def message_from_waypoints(waypoints: Sequence[Waypoint]) -> JointTrajectory:
    """A message with one point for each waypoint; stamp zero: the trajectory starts when it arrives."""
    points = []
    for time_ns, position, velocity in waypoints:
        sec, nanosec = divmod(time_ns, NANOSECONDS)
        after = Duration(sec=sec, nanosec=nanosec)
        points.append(JointTrajectoryPoint(positions=[position], velocities=[velocity], time_from_start=after))
    return JointTrajectory(joint_names=[STAGE], points=points)
