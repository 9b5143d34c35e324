"""The movements of the stage in a cycle: their waypoints, their progress, and whether the stage has arrived."""

from collections.abc import Sequence

from straightcomp_ros.cell.observation import Observation
from straightcomp_ros.model.motion import MotionParameters, Waypoint, cycles, trapezoid

_ARRIVE_WITHIN_S = 5.0
_ARRIVED_M = 10e-6
_ARRIVED_SHARE = 0.9995
"""Fraction of a movement's time: in lockstep the last sample may come before the end of the motion."""
_NS = 1e9


class NotArrived(Exception):
    """The stage did not reach the end of its movement; the message says where it stands."""


class StageMovements:
    """Counts the strokes of a cycle.

    Args:
        motion: of each stroke.
        as_one: all strokes are one trajectory, timed by the driver; otherwise the stage gets one movement after the
            other, so that the cycle can be held and stopped between them.

    Attributes:
        strokes, strokes_done: numbers of requested and finished strokes in this cycle, each forward and back.
    """

    def __init__(self, motion: MotionParameters, as_one: bool) -> None:
        self._motion, self.as_one = motion, as_one
        self._begin_ns = self._duration_ns = 0
        self._goal = self._latest = 0.0
        self.begin(0)

    def begin(self, strokes: int) -> None:
        """Begin another cycle."""
        self.strokes, self.strokes_done, self._number = strokes, 0, 0
        self.forget()

    def forget(self) -> None:
        """Stop following the current movement."""
        self._under_way = False

    def next(self, seen: Observation, now: float) -> Sequence[Waypoint]:
        """Waypoints of the next movement, which begins at ``now`` (clock, s)."""
        waypoints = cycles(self._motion, self.strokes) if self.as_one else self._one(seen.x)
        self._duration_ns, self._goal, _ = waypoints[-1]
        self._begin_ns, self._latest = seen.stamp_ns, now + self._duration_ns / _NS + _ARRIVE_WITHIN_S
        self._under_way = True
        return waypoints

    def progress(self, seen: Observation) -> float:
        """Fraction of the movement's time elapsed at the newest sample; 0 without a movement."""
        if not self._under_way:
            return 0.0
        # In lockstep there is no sample before the movement.
        return (seen.stamp_ns - (self._begin_ns or seen.first_ns)) / max(self._duration_ns, 1)

    def arrived(self, seen: Observation, now: float) -> bool:
        """Whether no movement is running; counts one that has just ended.

        Raises:
            NotArrived: the stage stands elsewhere 5 s after the end of the movement.
        """
        there = self.as_one or (seen.still and abs(seen.x - self._goal) < _ARRIVED_M)
        if self._under_way and there and self.progress(seen) > _ARRIVED_SHARE:
            self.forget()
            self._number += 1
            self.strokes_done = self.strokes if self.as_one else self._number // 2
        elif self._under_way and seen.still and now > self._latest and not self.as_one:
            self.forget()
            raise NotArrived(f"the stage did not arrive at {self._goal:.6f} m; it stands at {seen.x:.6f} m")
        return not self._under_way

    def _one(self, here: float) -> list[Waypoint]:
        """A rest and a move from ``here`` (m), forward and back in turn; only the rest if the stage is at its goal."""
        rest = self._motion.pause if self._number else self._motion.settle
        goal = self._motion.start + (0.0 if self._number % 2 else self._motion.stroke)
        points = [Waypoint(0, here, 0.0), Waypoint(round(rest * _NS), here, 0.0)]
        return [*points, *trapezoid(points[-1], goal, self._motion.speed, self._motion.acceleration)]
