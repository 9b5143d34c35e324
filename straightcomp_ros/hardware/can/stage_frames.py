"""A trajectory for the stage of a simulated machine, in frames of its own. No board uses them.

A real stage has a controller of its own and moves by itself; the emulator's needs to be told. Each waypoint takes
two frames, a last one starts the motion and seals them all. Classic frames on either kind of bus.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

from straightcomp_ros.hardware.can.frames import Identifiers
from straightcomp_ros.hardware.interface import HardwareError
from straightcomp_ros.model.stage import Trajectory, Waypoint

_POSITION = 1e-8
"""m"""
_VELOCITY = 1e-5
"""m/s"""
_START = struct.Struct("<BI")
_MOST_POINTS = 255


def stage_payloads(ids: Identifiers, waypoints: Sequence[Waypoint]) -> list[tuple[int, bytes]]:
    """(identifier, payload) of the frames that move a simulated stage, in the order of sending.

    Raises:
        HardwareError: too many points, or one that does not fit its frame.
    """
    if len(waypoints) > _MOST_POINTS:
        raise HardwareError(f"stage trajectory has {len(waypoints)} points; allowed over CAN: <= {_MOST_POINTS}")
    frames = []
    for number, point in enumerate(waypoints):
        try:
            motion = round(point.position / _POSITION).to_bytes(4, "little", signed=True)
            motion += round(point.velocity / _VELOCITY).to_bytes(3, "little", signed=True)
            frames.append((ids.stage_time, bytes((number,)) + point.time_ns.to_bytes(7, "little")))
        except OverflowError as error:
            raise HardwareError(f"stage trajectory, point {number}: {point} does not fit its CAN frames") from error
        frames.append((ids.stage_motion, bytes((number,)) + motion))
    seal = zlib.crc32(b"".join(payload for _, payload in frames))
    return [*frames, (ids.stage_start, _START.pack(len(waypoints), seal))]


class StageInbox:
    """Gathers the frames of :func:`stage_payloads` on the simulated machine's side."""

    def __init__(self, ids: Identifiers) -> None:
        self._ids = ids
        self._times: dict[int, bytes] = {}
        self._motions: dict[int, bytes] = {}

    def add(self, identifier: int, payload: bytes) -> Trajectory | None:
        """Take one frame; the frame that starts the motion gives the trajectory.

        Raises:
            HardwareError: frames before the start were lost or damaged.
            ValueError: the points make no trajectory.
        """
        if identifier == self._ids.stage_time and len(payload) == 8:
            self._times[payload[0]] = payload
        elif identifier == self._ids.stage_motion and len(payload) == 8:
            self._motions[payload[0]] = payload
        elif identifier == self._ids.stage_start and len(payload) == _START.size:
            return self._trajectory(*_START.unpack(payload))
        return None

    def _trajectory(self, points: int, seal: int) -> Trajectory:
        times, motions = self._times, self._motions
        self._times, self._motions = {}, {}
        numbers = range(points)
        if not all(number in times and number in motions for number in numbers):
            raise HardwareError(f"stage trajectory of {points} points is refused: frames of it are missing")
        if zlib.crc32(b"".join(times[number] + motions[number] for number in numbers)) != seal:
            raise HardwareError(f"stage trajectory of {points} points is refused: its CRC-32 is wrong")
        return Trajectory([_waypoint(times[number], motions[number]) for number in numbers])


def _waypoint(time: bytes, motion: bytes) -> Waypoint:
    return Waypoint(
        int.from_bytes(time[1:], "little"),
        int.from_bytes(motion[1:5], "little", signed=True) * _POSITION,
        int.from_bytes(motion[5:], "little", signed=True) * _VELOCITY,
    )
