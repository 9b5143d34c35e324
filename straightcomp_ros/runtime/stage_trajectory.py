"""The stage's trajectory as a trajectory_msgs/JointTrajectory, and back."""

from collections.abc import Sequence

from builtin_interfaces.msg import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from straightcomp_ros.contract import STAGE
from straightcomp_ros.messages.cdr import NANOSECONDS
from straightcomp_ros.model.motion import Trajectory, Waypoint


def message_from_waypoints(waypoints: Sequence[Waypoint]) -> JointTrajectory:
    """A message with one point for each waypoint; stamp zero: the trajectory starts when it arrives."""
    points = []
    for time_ns, position, velocity in waypoints:
        sec, nanosec = divmod(time_ns, NANOSECONDS)
        after = Duration(sec=sec, nanosec=nanosec)
        points.append(JointTrajectoryPoint(positions=[position], velocities=[velocity], time_from_start=after))
    return JointTrajectory(joint_names=[STAGE], points=points)


def trajectory_from_message(message: JointTrajectory) -> Trajectory:
    """Read a trajectory of the stage; a point without a velocity is at rest.

    Raises:
        ValueError: the stage is not among the joints, or a point lacks its position.
    """
    if STAGE not in message.joint_names:
        raise ValueError(f"joints {list(message.joint_names)} do not include '{STAGE}'")
    place = list(message.joint_names).index(STAGE)
    waypoints = []
    for number, point in enumerate(message.points):
        if len(point.positions) <= place:
            raise ValueError(f"point {number} has no position for '{STAGE}'")
        time_ns = point.time_from_start.sec * NANOSECONDS + point.time_from_start.nanosec
        velocity = point.velocities[place] if len(point.velocities) > place else 0.0
        waypoints.append(Waypoint(time_ns, point.positions[place], velocity))
    return Trajectory(waypoints)
