"""Motion of the stage along X: trapezoidal velocity profiles as a trajectory of waypoints.

Between waypoints the position is the cubic Hermite polynomial, as in joint trajectory controllers; between the corners
of a trapezoid that is the exact parabola or line.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from straightcomp_ros.contract import STROKE
from straightcomp_ros.settings.declaration import RefusedParameter, parameter

_NS = 1e9
_HEADROOM = 1.5
"""Least ratio of the speed that the stage cannot reach to its cruising speed."""


class Waypoint(NamedTuple):
    """Time from the trajectory's start in ns, position in m, velocity in m/s."""

    time_ns: int
    position: float
    velocity: float


@dataclass(frozen=True)
class MotionParameters:
    """A cycle of the stage: settle, forward stroke, pause, backward stroke, settle."""

    start: float = parameter(0.0, "Position at which the stroke starts", "[-100, 100] m")
    stroke: float = parameter(STROKE, "Length of the stroke", "(0, 100] m")
    speed: float = parameter(0.3, "Cruising speed", "(0, 20] m/s")
    highest_speed: float = parameter(
        2.0, "Speed that the stage cannot reach: a faster change of x is a wrong reading", "(0, 100] m/s"
    )
    acceleration: float = parameter(0.2, "Acceleration and deceleration", "(0, 200] m/s²")
    settle: float = parameter(1.0, "Time at rest before and after each stroke", "[0, 60] s")
    pause: float = parameter(0.5, "Time at rest between forward and back", "[0, 60] s")

    def __post_init__(self) -> None:
        if self.highest_speed < _HEADROOM * self.speed:
            raise RefusedParameter(
                "highest_speed",
                f"{self.highest_speed!r} m/s is too near the cruising speed; allowed: >= "
                f"{_HEADROOM * self.speed:g} m/s ({_HEADROOM:g} times '{{group}}speed')",
            )


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
    """Waypoints of one cycle, from time 0; it ends at rest where it began."""
    points = [Waypoint(0, motion.start, 0.0)]
    for rest, goal in ((motion.settle, motion.start + motion.stroke), (motion.pause, motion.start)):
        points.append(points[-1]._replace(time_ns=points[-1].time_ns + round(rest * _NS)))
        points += trapezoid(points[-1], goal, motion.speed, motion.acceleration)
    return [*points, points[-1]._replace(time_ns=points[-1].time_ns + round(motion.settle * _NS))]


def cycles(motion: MotionParameters, count: int) -> list[Waypoint]:
    """Waypoints of ``count`` cycles, one after the other."""
    once = forward_and_back(motion)
    end_ns = once[-1].time_ns
    return [point._replace(time_ns=point.time_ns + cycle * end_ns) for cycle in range(count) for point in once]


class Trajectory:
    """Position over time through waypoints; at rest before the first and after the last.

    Raises:
        ValueError: no waypoints, a number that is not finite, times that do not increase, or no rest at the end.
    """

    def __init__(self, waypoints: Sequence[Waypoint]) -> None:
        points: list[Waypoint] = []
        for number, point in enumerate(waypoints):
            place = f"stage trajectory, point {number}"
            if not (math.isfinite(point.position) and math.isfinite(point.velocity)):
                raise ValueError(f"{place}: position or velocity is not finite")
            # A settling time of zero repeats a point.
            if points and point == points[-1]:
                continue
            if points and point.time_ns <= points[-1].time_ns:
                raise ValueError(f"{place}: time {point.time_ns / _NS} s is not after {points[-1].time_ns / _NS} s")
            points.append(point)
        if not points:
            raise ValueError("stage trajectory has no points")
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
        """Time of the last waypoint, ns."""
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
