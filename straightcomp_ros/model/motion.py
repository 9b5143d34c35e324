"""Motion of the stage along X: its description, and what follows from it as a trajectory of waypoints.

Between waypoints the position is the cubic Hermite polynomial, as in joint trajectory controllers. Between the corners
of a trapezoid that is the exact parabola or line, and with a limit of the jerk the exact cubic.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.contract import STROKE
from straightcomp_ros.parameters.declaration import ParameterError, RefusedParameter, parameter
from straightcomp_ros.parameters.share import named_file
from straightcomp_ros.parameters.yaml_text import bounded_lines, number_rows

T = TypeVar("T", float, NDArray[np.float64])
_NS = 1e9
_SHORTEST_NS = 10_000
"""Of a phase: of a shorter one, times rounded to 1 ns say little of the acceleration."""
_POSITIONS = {"position in m": 100.0}
"""Of a file; as far as the parameter `start`."""
_MOST_POSITIONS = 1000
"""Of a file: as many as of equal steps."""
_LEAST_JERK = 1e-6
_LONGEST_S = 1e6
"""Of a cycle: a week and a half."""
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
    """A cycle of the stage: settle, move to each position in turn with a pause at each, move back to the start, settle.
    The positions are the end of the stroke alone, or equal steps along it, or those of a file."""

    start: float = parameter(0.0, "Position at which the stroke starts", "[-100, 100] m")
    stroke: float = parameter(STROKE, "Length of the stroke; negative: backward first", "[-100, 100] m")
    steps: int = parameter(
        1, "Number of equal steps of the stroke; the stage rests for 'pause' after each", "[1, 1000]"
    )
    file: str = parameter(
        "", "File of positions that the stage goes to in turn, one number in m a line, in place of the stroke's"
    )
    speed: float = parameter(0.3, "Cruising speed", "[1e-9, 20] m/s")
    highest_speed: float = parameter(
        2.0, "Speed that the stage cannot reach: a faster change of x is a wrong reading", "(0, 100] m/s"
    )
    acceleration: float = parameter(0.2, "Acceleration and deceleration", "(0, 200] m/s²")
    jerk: float = parameter(
        0.0, "Jerk of strokes, for S-curves of the speed; 0: no limit, which is a trapezoid", "[0, 1e6] m/s³"
    )
    settle: float = parameter(1.0, "Time at rest before and after each cycle", "[0, 86400] s")
    pause: float = parameter(0.5, "Time at rest at each position of a cycle", "[0, 86400] s")

    def __post_init__(self) -> None:
        if self.stroke == 0.0:
            raise RefusedParameter("stroke", "0.0 m is no stroke; allowed: a length other than 0")
        if 0.0 < self.jerk < _LEAST_JERK:
            raise RefusedParameter("jerk", f"{self.jerk!r} m/s³; allowed: 0, or >= {_LEAST_JERK:g} m/s³")
        if self.highest_speed < _HEADROOM * self.speed:
            raise RefusedParameter(
                "highest_speed",
                f"{self.highest_speed!r} m/s is too near the cruising speed; allowed: >= "
                f"{_HEADROOM * self.speed:g} m/s ({_HEADROOM:g} times '{{group}}speed')",
            )


def trapezoid(start: Waypoint, goal: float, speed: float, acceleration: float) -> list[Waypoint]:
    """Corners of a rest-to-rest move from ``start`` (not repeated) to ``goal``; a triangle if too short to cruise."""
    distance = abs(goal - start.position)
    if _is_there(distance, acceleration):
        return []
    direction = math.copysign(1.0, goal - start.position)
    peak = min(speed, math.sqrt(acceleration * distance))
    ramp = peak / acceleration
    ramp_distance = 0.5 * peak * ramp
    cruise = (distance - 2.0 * ramp_distance) / peak
    corners = [(ramp, start.position + direction * ramp_distance, direction * peak)]
    # Rounding may leave a cruise of 1e-16 s in what is a triangle.
    if round((ramp + cruise) * _NS) > round(ramp * _NS):
        corners.append((ramp + cruise, goal - direction * ramp_distance, direction * peak))
    corners.append((2.0 * ramp + cruise, goal, 0.0))
    return [Waypoint(start.time_ns + round(time * _NS), position, velocity) for time, position, velocity in corners]


def _is_there(distance: float, acceleration: float) -> bool:
    """Whether this distance is one of rounding: it would take no more than two nanoseconds."""
    return distance <= acceleration / _NS**2


def move(start: Waypoint, goal: float, speed: float, acceleration: float, jerk: float = 0.0) -> list[Waypoint]:
    """As :func:`trapezoid`, with a limit of the jerk in m/s³ unless that is 0: the corners of seven phases, or of those
    of them that the distance leaves."""
    distance = abs(goal - start.position)
    if jerk == 0.0 or _is_there(distance, acceleration):
        return trapezoid(start, goal, speed, acceleration)
    build = acceleration / jerk  # s, until the acceleration is there
    peak = 0.5 * acceleration * (math.sqrt(build * build + 4.0 * distance / acceleration) - build)
    if peak < acceleration * build:  # too short for the whole acceleration
        peak = (0.25 * distance * distance * jerk) ** (1.0 / 3.0)
    peak = min(peak, speed)
    bend = min(build, math.sqrt(peak / jerk))
    hold = peak / (jerk * bend) - bend
    if hold * _NS <= _SHORTEST_NS:
        # Its corners would be one: the acceleration rises for longer instead, and no higher.
        bend, hold = bend + hold, 0.0
        jerk = peak / bend**2
    ramp, ramp_distance = 2.0 * bend + hold, 0.5 * peak * (2.0 * bend + hold)
    first = jerk * bend**3 / 6.0, 0.5 * jerk * bend * bend
    second = first[0] + first[1] * hold + 0.5 * jerk * bend * hold * hold, first[1] + jerk * bend * hold
    rising = [(bend, *first), (bend + hold, *second), (ramp, ramp_distance, peak)]
    total = 2.0 * ramp + (distance - 2.0 * ramp_distance) / peak
    corners = [*rising, *((total - time, distance - way, v) for time, way, v in reversed([(0.0, 0.0, 0.0), *rising]))]
    sign, points = math.copysign(1.0, goal - start.position), [start]
    for time, way, v in corners:
        at_ns = start.time_ns + round(time * _NS)
        if at_ns > points[-1].time_ns + _SHORTEST_NS:
            points.append(Waypoint(at_ns, start.position + sign * way, sign * v))
    return [*points[1:-1], Waypoint(points[-1].time_ns, goal, 0.0)] if points[1:] else []


def jog(motion: MotionParameters, start: float, distance: float) -> list[Waypoint]:
    """Waypoints of a move at once by ``distance`` (m, either way) from ``start`` at rest, with the speed of strokes.
    Instead of for a time t, move by t times the speed."""
    here = Waypoint(0, start, 0.0)
    return [here, *move(here, start + distance, motion.speed, motion.acceleration, motion.jerk)]


def goals(motion: MotionParameters) -> list[float]:
    """The positions of a cycle in m, in order; the last is its start. ParameterError: the file is refused."""
    if not motion.file:
        return [*(motion.start + motion.stroke * k / motion.steps for k in range(1, motion.steps + 1)), motion.start]
    where = f"parameter 'stage.motion.file': {motion.file}"
    found = number_rows(bounded_lines(named_file(motion.file), where), where, _POSITIONS, header=False)[:, 0].tolist()
    if not 0 < len(found) <= _MOST_POSITIONS:
        raise ParameterError(f"{where}: {len(found)} positions; allowed: 1 to {_MOST_POSITIONS}")
    return [*found, motion.start]


def reach(motion: MotionParameters) -> tuple[float, float]:
    """The least and the greatest position of a cycle in m. ParameterError as of :func:`goals`."""
    found = goals(motion)
    return min(found), max(found)


def forward_and_back(motion: MotionParameters) -> list[Waypoint]:
    """Waypoints of one cycle, from time 0; it ends at rest where it began. ParameterError as of :func:`goals`, and for
    one that takes more than 1e6 s."""
    points = [Waypoint(0, motion.start, 0.0)]
    for number, goal in enumerate(goals(motion)):
        rest = motion.pause if number else motion.settle
        points.append(points[-1]._replace(time_ns=points[-1].time_ns + round(rest * _NS)))
        points += move(points[-1], goal, motion.speed, motion.acceleration, motion.jerk)
    if points[-1].time_ns > _LONGEST_S * _NS:
        raise ParameterError(
            f"parameters 'stage.motion.*': a cycle takes {points[-1].time_ns / _NS:.3g} s; allowed: <= {_LONGEST_S:g} s"
        )
    return [*points, points[-1]._replace(time_ns=points[-1].time_ns + round(motion.settle * _NS))]


def cycles(motion: MotionParameters, count: int) -> list[Waypoint]:
    """Waypoints of ``count`` cycles, one after the other, each from the last point of the one before."""
    first, *once = forward_and_back(motion)
    end_ns = once[-1].time_ns
    return [first, *(point._replace(time_ns=point.time_ns + k * end_ns) for k in range(count) for point in once)]


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

    def shifted(self, by: float) -> "Trajectory":
        """The same motion at positions that are ``by`` (m) larger."""
        return Trajectory.from_columns(self.times, self.positions + by, self.velocities)

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

    def position(self, time_ns: float) -> float:
        """Position in m at ``time_ns`` from the trajectory's start."""
        after = bisect_right(self._times, time_ns)
        if after == 0:
            return self._points[0][1]
        if after == len(self._points):
            return self._points[-1][1]
        return _between(self._points[after - 1], self._points[after], time_ns)

    def at(self, times: NDArray[np.int64]) -> NDArray[np.float64]:
        """:meth:`position` at ``times`` (n,) in ns, the same to the last bit."""
        if self.times.size == 1:
            return np.full(times.shape, self.positions[0])
        after = np.searchsorted(self.times, times, side="right").clip(1, self.times.size - 1)
        columns = self.times, self.positions, self.velocities
        first, then = ([column[at] for column in columns] for at in (after - 1, after))
        return _between(first, then, times.clip(self.times[0], self.times[-1]))

    def rates(self, time_ns: float) -> tuple[float, float]:
        """Velocity in m/s and acceleration in m/s² at ``time_ns``; after a corner, those of what follows it."""
        after = bisect_right(self._times, time_ns)
        if after == 0 or after == len(self._points):
            return 0.0, 0.0
        t0, p0, v0 = self._points[after - 1]
        t1, p1, v1 = self._points[after]
        span = (t1 - t0) / _NS
        s = (time_ns - t0) / (t1 - t0)
        # Coefficients of the velocity as a polynomial in s.
        mean = (p1 - p0) / span
        bend, curl = 6.0 * mean - 4.0 * v0 - 2.0 * v1, 3.0 * (v0 + v1) - 6.0 * mean
        return v0 + s * (bend + s * curl), (bend + 2.0 * s * curl) / span

    @cached_property
    def largest_acceleration(self) -> float:
        """In m/s², of either sign."""
        h, (before, after) = np.diff(self.times) / _NS, (self.velocities[:-1], self.velocities[1:])
        mean = np.diff(self.positions) / h
        ends = np.abs([6.0 * mean - 4.0 * before - 2.0 * after, 4.0 * after + 2.0 * before - 6.0 * mean]) / h
        return float(np.max(ends[:, np.diff(self.times) > _SHORTEST_NS], initial=0.0))


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
        first, last = reach(motion)
        low, high = min(low, first), max(high, last)
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
            # Of a long cruise the quotient is noise, but the velocity there is not.
            turn = np.clip(np.nan_to_num((v0 - middle) / bend), 0.0, 1.0)
            peak = v0 * (1.0 - turn) ** 2 + 2.0 * middle * turn * (1.0 - turn) + v1 * turn * turn
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


def _between(first: Sequence[Any], then: Sequence[Any], time_ns: T) -> T:
    """Position in m between two waypoints; the same operations, and so the same bits, for numbers and for arrays."""
    (t0, p0, v0), (t1, p1, v1) = first, then
    span = (t1 - t0) / _NS
    s = (time_ns - t0) / (t1 - t0)
    rest = 1.0 - s
    bend = s * rest * span * (rest * v0 - s * v1)
    position: T = (1.0 + 2.0 * s) * rest * rest * p0 + s * s * (3.0 - 2.0 * s) * p1 + bend
    return position
