"""Reads one joint's motion from the bytes of a trajectory_msgs/JointTrajectory.

A control loop reads it. A message object would cost it 3 µs a point, and its checks more, where a sample has 500 µs.
Points with arrays of the same lengths have the same layout, and NumPy reads them at once.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from straightcomp_ros.messages.cdr import ENCAPSULATION, NANOSECONDS, SHORTEST, header_stamp_ns

MOST_POINTS = 10_000
"""The most strokes of a cycle, 1000, have 9 points each without a limit of the jerk."""
_MOST_JOINTS, _MOST_LAYOUTS = 64, 16
_ARRAYS = ("positions", "velocities", "accelerations", "effort")
_LENGTH = struct.Struct("<I")

Columns = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def read_trajectory(data: bytes, joint: str) -> tuple[int, Columns]:
    """The stamp in ns, 0 without one; times in ns, positions in m and velocities in m/s of ``joint``, (n,) each. A
    point without a velocity is at rest.

    The number of points is checked before any is read.

    Raises:
        ValueError: the joint or a position is missing, a time is before the start, there are too many points, or the
            message is incomplete.
    """
    if data[:2] != ENCAPSULATION[:2]:
        raise ValueError(f"stage trajectory: encapsulation {data[:2].hex()} is not little-endian CDR")
    try:
        return header_stamp_ns(data), _columns(_Cursor(data[len(ENCAPSULATION) :]), joint)
    except struct.error:
        raise ValueError(f"stage trajectory: {len(data)} bytes are no whole message") from None


class _Cursor:
    """Reads the fields after the stamp one by one; CDR aligns relative to the end of the encapsulation."""

    def __init__(self, body: bytes) -> None:
        self._body, self._at = body, SHORTEST - len(ENCAPSULATION)

    def length(self) -> int:
        self._at += -self._at % 4
        (length,) = _LENGTH.unpack_from(self._body, self._at)
        self._at += 4
        return int(length)

    def text(self) -> str:
        length, begin = self.length(), self._at
        self._at += length
        if self._at > len(self._body):
            raise struct.error
        return self._body[begin : self._at].rstrip(b"\0").decode(errors="replace")

    def points(self, most: int) -> NDArray[np.void]:
        """Up to ``most`` points: as many as have the layout of the next one, which is at least one."""
        begin = self._at
        names, formats, offsets = list[str](), list[Any](), list[int]()
        for name in _ARRAYS:
            length = self.length()
            names += [f"{name} length", name]
            offsets.append(self._at - 4 - begin)
            if length:
                self._at += -self._at % 8
            offsets.append(self._at - begin)
            formats += ["<u4", ("<f8", (length,))]
            self._at += 8 * length
        names += ["sec", "nanosec"]
        formats += ["<i4", "<u4"]
        offsets += [self._at - begin, self._at + 4 - begin]
        size = self._at + 8 - begin
        # Otherwise the next point is aligned in another way.
        most = min(most if size % 8 == 0 else 1, (len(self._body) - begin) // size)
        if most < 1:
            raise struct.error
        layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})
        points = np.frombuffer(self._body, layout, most, begin)
        alike = np.ones(most, bool)
        for name in _ARRAYS:
            alike &= points[f"{name} length"] == points[name].shape[1]
        if not alike.all():
            points = points[: int(alike.argmin())]
        self._at = begin + size * len(points)
        return points


def _columns(cursor: _Cursor, joint: str) -> Columns:
    cursor.text()  # frame
    count = cursor.length()
    if count > _MOST_JOINTS:
        raise ValueError(f"stage trajectory has {count} joints; allowed: <= {_MOST_JOINTS}")
    joints = [cursor.text() for _ in range(count)]
    if joint not in joints:
        raise ValueError(f"stage trajectory: joints {str(joints)[:200]} do not include '{joint}'")
    place, count = joints.index(joint), cursor.length()
    if count > MOST_POINTS:
        raise ValueError(f"stage trajectory has {count} points; allowed: <= {MOST_POINTS}")
    times, positions, velocities = np.empty(count, np.int64), np.empty(count), np.zeros(count)
    begin = layouts = 0
    while begin < count:
        points, layouts = cursor.points(count - begin), layouts + 1
        if layouts > _MOST_LAYOUTS:
            raise ValueError(
                f"stage trajectory: the points change {layouts} times in what they have; allowed: <= {_MOST_LAYOUTS}"
            )
        if points["positions"].shape[1] <= place:
            raise ValueError(f"stage trajectory, point {begin} has no position for '{joint}'")
        part = slice(begin, begin + len(points))
        # NumPy 1 multiplies an array of int32 by a scalar of int64 in int32.
        times[part] = points["sec"].astype(np.int64) * NANOSECONDS + points["nanosec"]
        positions[part] = points["positions"][:, place]
        if points["velocities"].shape[1] > place:
            velocities[part] = points["velocities"][:, place]
        begin = part.stop
    if (times < 0).any():
        first = int((times < 0).argmax())
        raise ValueError(f"stage trajectory, point {first}: time {times[first] / NANOSECONDS} s; allowed: >= 0 s")
    return times, positions, velocities
