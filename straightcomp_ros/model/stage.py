"""Motion of the stage along X: trapezoidal velocity profiles as a trajectory of waypoints.

Between waypoints the motion is the cubic Hermite polynomial of positions and velocities, as joint
trajectory controllers interpolate; for the corners of a trapezoid it is the exact parabola or line.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.contract import STROKE
from straightcomp_ros.settings.declaration import parameter

_NS = 1e9


class Waypoint(NamedTuple):
    """Time from the trajectory's start in ns, position in m, velocity in m/s."""

    time_ns: int
    position: float
    velocity: float


@dataclass(frozen=True)
class MotionParameters:
    """A cycle of the stage: settle, forward stroke, pause, backward stroke, settle."""

    start: float = parameter(0.0, "Position at which the stroke starts", unit="m", minimum=-100.0, maximum=100.0)
    stroke: float = parameter(STROKE, "Length of the stroke", unit="m", above=0.0, maximum=100.0)
    speed: float = parameter(0.3, "Cruising speed", unit="m/s", above=0.0, maximum=20.0)
    acceleration: float = parameter(0.2, "Acceleration and deceleration", unit="m/s²", above=0.0, maximum=200.0)
    settle: float = parameter(1.0, "Time at rest before and after each stroke", unit="s", minimum=0.0, maximum=60.0)
    pause: float = parameter(0.5, "Time at rest between forward and back", unit="s", minimum=0.0, maximum=60.0)


def trapezoid(start: Waypoint, goal: float, speed: float, acceleration: float) -> list[Waypoint]:
    """Corners of a rest-to-rest move from ``start`` (not repeated) to ``goal``; a triangle if too short to cruise."""
    distance = abs(goal - start.position)
    if distance == 0.0:
        return []
    direction = math.copysign(1.0, goal - start.position)
    peak = min(speed, math.sqrt(acceleration * distance))
    ramp = peak / acceleration
    ramp_distance = 0.5 * peak * ramp
    cruise = (distance - 2.0 * ramp_distance) / peak
    corners = [(ramp, start.position + direction * ramp_distance, direction * peak)]
    # Rounding may leave a cruise of 1e-16 s in what is a triangle.
    if round(cruise * _NS) > 0:
        corners.append((ramp + cruise, goal - direction * ramp_distance, direction * peak))
    corners.append((2.0 * ramp + cruise, goal, 0.0))
    return [Waypoint(start.time_ns + round(time * _NS), position, velocity) for time, position, velocity in corners]


def forward_and_back(motion: MotionParameters) -> list[Waypoint]:
    """Waypoints of one cycle, starting at time 0 and ending at rest where it began."""
    points = [Waypoint(0, motion.start, 0.0), Waypoint(round(motion.settle * _NS), motion.start, 0.0)]
    points += trapezoid(points[-1], motion.start + motion.stroke, motion.speed, motion.acceleration)
    points.append(Waypoint(points[-1].time_ns + round(motion.pause * _NS), motion.start + motion.stroke, 0.0))
    points += trapezoid(points[-1], motion.start, motion.speed, motion.acceleration)
    points.append(Waypoint(points[-1].time_ns + round(motion.settle * _NS), motion.start, 0.0))
    return points


def cycles(motion: MotionParameters, count: int) -> list[Waypoint]:
    """Waypoints of so many cycles, one after the other."""
    once = forward_and_back(motion)
    end_ns = once[-1].time_ns
    return [point._replace(time_ns=point.time_ns + cycle * end_ns) for cycle in range(count) for point in once]


class Trajectory:
    """Position over time through waypoints; at rest before the first and after the last.

    Raises:
        ValueError: no waypoints, non-finite numbers, times that do not increase, or a trajectory that
            does not end at rest (the stage would have to stop with a jump).
    """

    def __init__(self, waypoints: Sequence[Waypoint]) -> None:
        if not waypoints:
            raise ValueError("stage trajectory has no points")
        points = [waypoints[0]]
        for number, point in enumerate(waypoints[1:], 1):
            # Two equal points, as a settling time of zero gives, are one.
            if point == points[-1]:
                continue
            if point.time_ns <= points[-1].time_ns:
                raise ValueError(
                    f"stage trajectory, point {number}: time {point.time_ns / _NS} s "
                    f"is not after {points[-1].time_ns / _NS} s"
                )
            points.append(point)
        for number, point in enumerate(points):
            if not (math.isfinite(point.position) and math.isfinite(point.velocity)):
                raise ValueError(f"stage trajectory, point {number}: position or velocity is not finite")
        if points[-1].velocity != 0.0:
            raise ValueError(f"stage trajectory ends at {points[-1].velocity} m/s; it must end at rest")
        self._points = points
        self._times = [point.time_ns for point in points]

    @property
    def waypoints(self) -> Sequence[Waypoint]:
        """The points, without repetitions."""
        return self._points

    @property
    def end_ns(self) -> int:
        """Time of the last waypoint from the start, ns."""
        return self._times[-1]

    def position(self, time_ns: int) -> float:
        """Position in m at ``time_ns`` from the trajectory's start."""
        after = bisect_right(self._times, time_ns)
        if after == 0:
            return self._points[0].position
        if after == len(self._points):
            return self._points[-1].position
        t0, p0, v0 = self._points[after - 1]
        t1, p1, v1 = self._points[after]
        span = (t1 - t0) / _NS
        s = (time_ns - t0) / (t1 - t0)
        rest = 1.0 - s
        return (
            (1.0 + 2.0 * s) * rest * rest * p0 + s * s * (3.0 - 2.0 * s) * p1 + s * rest * span * (rest * v0 - s * v1)
        )
