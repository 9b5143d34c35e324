"""Frames that only an emulated board uses: a trajectory for its stage, and the simulation's truth.

A real stage moves by its own controller; the emulator's stage has to be commanded. Each waypoint takes two frames; a
last frame with a checksum starts the motion. These are classic frames on either kind of bus.

The truth of a sample comes right before its encoder frame, on CAN FD only: it fills the longest frame there is.
"""

import struct
import zlib
from collections.abc import Sequence

from straightcomp_ros.hardware.can.frames import FrameError, Identifiers
from straightcomp_ros.hardware.interface import HardwareError, Truth
from straightcomp_ros.model.motion import Trajectory, Waypoint

_POSITION, _VELOCITY = 1e-8, 1e-5
"""m and m/s"""
_START = struct.Struct("<BI")
_MOST_POINTS = 255
_HEAD, _CONTENT = struct.Struct("<II"), struct.Struct("<6d8x")


def stage_payloads(ids: Identifiers, waypoints: Sequence[Waypoint]) -> list[tuple[int, bytes]]:
    """Identifier and payload of each frame that moves a simulated stage, in the order of sending.

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


class StageReceiver:
    """Collects the frames of :func:`stage_payloads` on the simulated machine's side."""

    def __init__(self, ids: Identifiers) -> None:
        self._ids = ids
        self._times: dict[int, bytes] = {}
        self._motions: dict[int, bytes] = {}

    def add(self, identifier: int, payload: bytes) -> Trajectory | None:
        """Take one frame; return the trajectory with the frame that starts the motion.

        Raises:
            HardwareError: frames before it were lost or damaged.
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
        try:
            frames = [(times[number], motions[number]) for number in range(points)]
        except KeyError as error:
            raise HardwareError(f"stage trajectory of {points} points is refused: frames of it are missing") from error
        if zlib.crc32(b"".join(time + motion for time, motion in frames)) != seal:
            raise HardwareError(f"stage trajectory of {points} points is refused: its CRC-32 is wrong")
        return Trajectory([_waypoint(*frame) for frame in frames])


def _waypoint(time: bytes, motion: bytes) -> Waypoint:
    return Waypoint(
        int.from_bytes(time[1:], "little"),
        int.from_bytes(motion[1:5], "little", signed=True) * _POSITION,
        int.from_bytes(motion[5:], "little", signed=True) * _VELOCITY,
    )


def truth_payload(counter: int, truth: Truth) -> bytes:
    """Sample counter, CRC-32 of the rest with the counter as start value, six doubles in SI units, 8 bytes of zero."""
    content = _CONTENT.pack(*truth)
    return _HEAD.pack(counter, zlib.crc32(content, counter)) + content


def truth_of(payload: bytes) -> tuple[int, Truth]:
    """Sample counter and truth; raises FrameError if the frame is damaged."""
    head, content = payload[: _HEAD.size], payload[_HEAD.size :]
    if len(content) != _CONTENT.size:
        raise FrameError("truth")
    counter, seal = _HEAD.unpack(head)
    if seal != zlib.crc32(content, counter):
        raise FrameError("truth")
    return counter, Truth(*_CONTENT.unpack(content))
