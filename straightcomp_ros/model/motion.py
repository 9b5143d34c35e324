"""Motion of the stage along X: trapezoidal velocity profiles as a trajectory of waypoints.

Between waypoints the position is the cubic Hermite polynomial, as in joint trajectory controllers; between the corners
of a trapezoid that is the exact parabola or line.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.contract import STROKE
from straightcomp_ros.parameters.declaration import RefusedParameter, parameter

_NS = 1e9
_HEADROOM = 1.5
"""Least ratio of the speed that the stage cannot reach to its cruising speed."""
_MOST_ACCELERATION = 10.0
"""Ratio of the acceleration that a trajectory may ask for to that of the strokes, which is far from what drives do."""


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

    ``times``, ``positions`` and ``velocities`` are those of the waypoints without repetitions, (n,) each, in ns, m and
    m/s. ValueError for no waypoints, a number that is not finite, times that do not increase, or no rest at the end.
    """

    def __init__(self, waypoints: Sequence[Waypoint]) -> None:
        times, positions, velocities = zip(*waypoints, strict=True) if waypoints else ((), (), ())
        self._take(np.array(times, np.int64), np.array(positions, np.float64), np.array(velocities, np.float64))

    @classmethod
    def from_columns(
        cls, times: NDArray[np.int64], positions: NDArray[np.float64], velocities: NDArray[np.float64]
    ) -> "Trajectory":
        """The trajectory through waypoints of these times in ns, positions in m and velocities in m/s, (n,) each."""
        trajectory = cls.__new__(cls)
        trajectory._take(times, positions, velocities)
        return trajectory

    def _take(self, times: NDArray[np.int64], positions: NDArray[np.float64], velocities: NDArray[np.float64]) -> None:
        if not times.size:
            raise ValueError("stage trajectory has no points")
        finite = np.isfinite(positions) & np.isfinite(velocities)
        if not finite.all():
            raise ValueError(f"stage trajectory, point {finite.argmin()}: position or velocity is not finite")
        # A settling time of zero repeats a point.
        fresh = np.arange(times.size) == 0
        for column in (times, positions, velocities):
            fresh[1:] |= column[1:] != column[:-1]
        (numbers,) = fresh.nonzero()
        times, positions, velocities = times[numbers], positions[numbers], velocities[numbers]
        self.times, self.positions, self.velocities = times, positions, velocities
        later = times[1:] > times[:-1]
        if not later.all():
            after = int(later.argmin())
            raise ValueError(
                f"stage trajectory, point {numbers[after + 1]}: time {times[after + 1] / _NS} s is not after "
                f"{times[after] / _NS} s"
            )
        if velocities[-1] != 0.0:
            raise ValueError(f"stage trajectory ends at {velocities[-1]} m/s; it must end at rest")
        self._times: list[int] = times.tolist()
        self._points: list[tuple[int, float, float]]
        self._points = list(zip(self._times, positions.tolist(), velocities.tolist(), strict=True))

    @property
    def waypoints(self) -> Sequence[Waypoint]:
        """The points, without repetitions."""
        return [Waypoint(*point) for point in self._points]

    @property
    def end_ns(self) -> int:
        """Time of the last waypoint, ns."""
        return self._times[-1]

    def position(self, time_ns: int) -> float:
        """Position in m at ``time_ns`` from the trajectory's start."""
        after = bisect_right(self._times, time_ns)
        if after == 0:
            return self._points[0][1]
        if after == len(self._points):
            return self._points[-1][1]
        t0, p0, v0 = self._points[after - 1]
        t1, p1, v1 = self._points[after]
        span = (t1 - t0) / _NS
        s = (time_ns - t0) / (t1 - t0)
        rest = 1.0 - s
        return (
            (1.0 + 2.0 * s) * rest * rest * p0 + s * s * (3.0 - 2.0 * s) * p1 + s * rest * span * (rest * v0 - s * v1)
        )


@dataclass(frozen=True)
class StageLimits:
    """What the stage can do: positions from ``low`` to ``high`` in m, ``speed`` in m/s, ``acceleration`` in m/s²."""

    low: float
    high: float
    speed: float
    acceleration: float

    @classmethod
    def of(cls, motion: MotionParameters, low: float, high: float) -> "StageLimits":
        """Those of the described strokes, and of the guide from ``low`` to ``high`` (m)."""
        low, high = min(low, motion.start), max(high, motion.start + motion.stroke)
        return cls(low, high, motion.highest_speed, _MOST_ACCELERATION * motion.acceleration)

    def check(self, trajectory: Trajectory) -> None:
        """Raise ValueError if a trajectory asks for more, also between two of its points."""
        p, v = trajectory.positions, trajectory.velocities
        with np.errstate(all="ignore"):
            h = np.diff(trajectory.times) / _NS
            # Times are rounded to 1 ns, which shows in the velocity between two points that are close together.
            slack = 6e-9 * self.speed / h
            v0, v1 = v[:-1], v[1:]
            # Bézier's control points enclose the positions; with those of the velocity, its peak is exact.
            outer = np.concatenate([p, p[:-1] + v0 * h / 3.0, p[1:] - v1 * h / 3.0])
            middle = 3.0 * np.diff(p) / h - v0 - v1
            bend = v0 - 2.0 * middle + v1
            turn = (v0 - middle) / bend
            peak = np.where((turn > 0.0) & (turn < 1.0), (v0 * v1 - middle * middle) / bend, 0.0)
            speed = np.maximum(np.maximum(abs(v0), abs(v1)), abs(peak) - slack)
            bent = 2.0 * (np.maximum(abs(middle - v0), abs(v1 - middle)) - slack)
            acceleration = np.maximum(bent, abs(v1 - v0)) / (h + 1e-9)
        later = np.arange(1, p.size)
        for values, numbers, low, high, unit in (
            (outer, np.concatenate([np.arange(p.size), later, later]), self.low, self.high, "m"),
            (speed, later, 0.0, self.speed, "m/s"),
            (acceleration, later, 0.0, self.acceleration, "m/s²"),
        ):
            within = (values >= low) & (values <= high)
            if not within.all():
                first = within.argmin()
                raise ValueError(
                    f"stage trajectory, on the way to point {numbers[first]}: {values[first]:g} {unit}; "
                    f"allowed for this stage: {low:g} to {high:g} {unit}"
                )
