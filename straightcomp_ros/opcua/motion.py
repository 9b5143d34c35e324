"""The strokes of a cycle, one movement at a time: after each the stage rests, and the cycle may be held or stopped."""

from __future__ import annotations

from collections.abc import Sequence

from straightcomp_ros.model.stage import MotionParameters, Waypoint, trapezoid

_NS = 1e9


def movement(motion: MotionParameters, here: float, number: int) -> Sequence[Waypoint]:
    """Movement ``number`` of a cycle: even ones go forward, odd ones back.

    Args:
        motion: start, stroke, speeds and rests.
        here: where the stage stands, m.
        number: counts from 0.

    Returns:
        A rest and a move from ``here``; only the rest where the stage is there already.
    """
    forward = number % 2 == 0
    rest = motion.settle if number == 0 else motion.pause
    goal = motion.start + (motion.stroke if forward else 0.0)
    points = [Waypoint(0, here, 0.0), Waypoint(round(rest * _NS), here, 0.0)]
    return [*points, *trapezoid(points[-1], goal, motion.speed, motion.acceleration)]
