"""Fixed-layout CDR: messages whose strings and lengths never change, packed and read by one `struct` call.

ROS 2 serialises a message as CDR (OMG DDS-XTypes 7.4, plain CDR, little endian). In a stream with constant names and
array lengths, every byte but the stamp and the numbers is constant too. A :class:`Layout` holds those constants and the
positions of the numbers. Packing then costs about 1 µs, where building and serialising a message object costs 15 µs,
and the same positions make a NumPy view of a whole bag. A message of another layout is refused, never misread.

Several messages of a stream are also packed into one, a batch; :mod:`straightcomp_ros.runtime.streams` says why.
A batch is a std_msgs/UInt8MultiArray. Its data are the messages one after the other, each serialised as if published
alone and preceded by the time at which it was made: int64, ns since the epoch, little endian. All messages of a stream
have the same size.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np

ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR, little endian
NANOSECONDS = 1_000_000_000
_HEADER_STAMP = struct.Struct("<iI")
SHORTEST = len(ENCAPSULATION) + _HEADER_STAMP.size
"""Bytes of a message's encapsulation and stamp."""
_NOT_A_STAMP = "a stamp with less than 1e9 nanoseconds"
BATCH_TYPE = "std_msgs/msg/UInt8MultiArray"
_BATCH_HEAD = struct.Struct("<4sIII")
"""Encapsulation, number of dimensions, data_offset, number of bytes."""
_MADE = struct.Struct("<q")


def append_aligned(message: bytearray, *fields: str | int) -> None:
    """Append strings and numbers of 32 bits without a sign to a serialised message, each at a multiple of 4 bytes."""
    for field_ in fields:
        message += bytes(-len(message) % 4)
        text = b"" if isinstance(field_, int) else field_.encode(errors="replace") + b"\0"
        message += (field_ if isinstance(field_, int) else len(text)).to_bytes(4, "little") + text


class LayoutMismatch(ValueError):
    """The bytes are not a message of this layout: other names or lengths, or truncated."""


@dataclass(frozen=True)
class Layout:
    """Positions of stamp and numbers in the bytes of one stream.

    Attributes:
        type_name: ROS type, e.g. ``sensor_msgs/msg/JointState``.
        columns: name of each number, in byte order.
        constants: the constant byte runs: after the stamp, and between the numbers.
        runs: number of float64 after each constant run.
        places: for each column the array of the message and the joint whose entry it is.
        gaps: places of bytes, counted behind the encapsulation, that only align what follows: other writers leave
            anything there.
        pack: ``pack(stamp_ns, *numbers)`` serialises one message: header stamp in ns since the epoch, and as many
            float64 as ``columns``.
        unpack: ``unpack(data)`` reads one: (stamp in ns, numbers in the order of ``columns``); raises
            :class:`LayoutMismatch` for other constants, or fewer bytes.
        size: size of a message in bytes.
    """

    type_name: str
    columns: tuple[str, ...]
    constants: tuple[bytes, ...]
    runs: tuple[int, ...]
    places: tuple[tuple[str, str], ...]
    gaps: tuple[int, ...]
    pack: Callable[..., bytes] = field(init=False, repr=False, compare=False)
    unpack: Callable[[bytes], tuple[int, tuple[float, ...]]] = field(init=False, repr=False, compare=False)
    size: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        parts = [f"{len(constant)}s{run}d" for constant, run in zip(self.constants, self.runs, strict=True)]
        packer = struct.Struct("<4siI" + "".join(parts))
        # Every message of a 2 kHz loop passes through these functions, so their constants are bound once, here.
        object.__setattr__(self, "pack", self._make_pack(packer))
        object.__setattr__(self, "unpack", self._make_unpack(packer))
        object.__setattr__(self, "size", packer.size)

    def _make_pack(self, packer: struct.Struct) -> Callable[..., bytes]:
        pack, constants = packer.pack, self.constants
        if len(constants) == 1:
            # A command, 2,000 a second in each direction: a fifth faster than in the general way.
            (constant,) = constants

            def pack_one_run(stamp_ns: int, *numbers: float) -> bytes:
                sec, nanosec = divmod(stamp_ns, NANOSECONDS)
                return pack(ENCAPSULATION, sec, nanosec, constant, *numbers)

            return pack_one_run
        order, number = [], len(constants)
        for index, run in enumerate(self.runs):
            order += [index, *range(number, number + run)]
            number += run
        in_order = itemgetter(*order)

        def pack_runs(stamp_ns: int, *numbers: float) -> bytes:
            sec, nanosec = divmod(stamp_ns, NANOSECONDS)
            return pack(ENCAPSULATION, sec, nanosec, *in_order(constants + numbers))

        return pack_runs

    def _make_unpack(self, packer: struct.Struct) -> Callable[[bytes], tuple[int, tuple[float, ...]]]:
        unpack_from = packer.unpack_from
        at_constants, at_numbers, place = [0], list[int](), 3
        for run in self.runs:
            at_constants.append(place)
            at_numbers.extend(range(place + 1, place + 1 + run))
            place += 1 + run
        expected, constant_fields = (ENCAPSULATION, *self.constants), itemgetter(*at_constants)
        # An itemgetter of one index returns the item itself; with a slice it returns a tuple.
        number_fields = (
            itemgetter(*at_numbers) if at_numbers[1:] else itemgetter(slice(at_numbers[0], at_numbers[0] + 1))
        )

        def unpack(data: bytes) -> tuple[int, tuple[float, ...]]:
            try:
                fields = unpack_from(data)
            except struct.error as error:
                raise LayoutMismatch(f"{self.type_name}: {len(data)} bytes, {self.size} expected") from error
            if constant_fields(fields) != expected:
                raise LayoutMismatch(
                    f"{self.type_name}: encapsulation {fields[0].hex()} is not little-endian CDR"
                    if fields[0] != ENCAPSULATION
                    else f"{self.type_name}: other names or array lengths than {self.columns}"
                )
            if fields[2] >= NANOSECONDS:
                raise LayoutMismatch(f"{self.type_name}: {_NOT_A_STAMP}")
            return fields[1] * NANOSECONDS + fields[2], number_fields(fields)

        return unpack

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Structured dtype of a message: ``encapsulation``, ``sec``, ``nanosec``, ``constant_<i>`` (bytes)
        and one float64 field for each column; packed, so that ``itemsize == size``."""
        fields: list[tuple[str, str]] = [("encapsulation", "V4"), ("sec", "<i4"), ("nanosec", "<u4")]
        names = iter(self.columns)
        for index, (constant, run) in enumerate(zip(self.constants, self.runs, strict=True)):
            fields.append((f"constant_{index}", f"V{len(constant)}"))
            fields.extend((next(names), "<f8") for _ in range(run))
        return np.dtype(fields)


def _layout(type_name: str, fields: Sequence[str | int | tuple[str, ...]], places: Sequence[tuple[str, str]]) -> Layout:
    """The layout of these fields after the stamp: texts, numbers (uint32), and arrays of float64 by their columns.

    CDR aligns relative to the end of the encapsulation.
    """
    offset, constant, constants, runs, gaps = 8, b"", list[bytes](), list[int](), list[int]()
    for one in fields:
        text = one.encode() + b"\0" if isinstance(one, str) else b""
        number = one if isinstance(one, int) else len(text or one)
        gaps += range(offset, offset + -offset % 4)
        added = bytes(-offset % 4) + struct.pack("<I", number) + text
        constant, offset = constant + added, offset + len(added)
        if isinstance(one, tuple) and one:
            padding = bytes(-offset % 8)
            gaps += range(offset, offset + len(padding))
            constants.append(constant + padding)
            runs.append(len(one))
            constant, offset = b"", offset + len(padding) + 8 * len(one)
    if constant:
        constants.append(constant)
        runs.append(0)
    columns = (column for one in fields if isinstance(one, tuple) for column in one)
    return Layout(type_name, tuple(columns), tuple(constants), tuple(runs), tuple(places), tuple(gaps))


def read_by_names(layout: Layout, message: Any) -> tuple[int, list[float]]:
    """Stamp in ns and numbers in the order of ``layout.columns`` of a deserialised message (of rclpy or rosbags) with
    the layout's joints in any order; LayoutMismatch names a joint, an array or a point that is missing."""
    stamp = message.header.stamp
    if layout.type_name == "sensor_msgs/msg/JointState":
        names, arrays = list(message.name), message
    else:
        if not message.points:
            raise LayoutMismatch("a point")
        names, arrays = list(message.joint_names), message.points[0]
    numbers = []
    for array, joint in layout.places:
        values = getattr(arrays, array)
        if joint not in names or names.index(joint) >= len(values):
            raise LayoutMismatch(f"{array} of '{joint}'")
        numbers.append(float(values[names.index(joint)]))
    if stamp.nanosec >= NANOSECONDS:
        raise LayoutMismatch(_NOT_A_STAMP)
    return stamp.sec * NANOSECONDS + stamp.nanosec, numbers


def joint_state(names: Sequence[str], *, position: Sequence[str] = (), effort: Sequence[str] = ()) -> Layout:
    """Layout of a sensor_msgs/JointState of the joints ``names`` with an empty frame_id and no velocities.

    ``position`` and ``effort`` are the columns of each array, for the first joints; () leaves it empty.
    """
    arrays = {"position": tuple(position), "velocity": (), "effort": tuple(effort)}
    places = [(array, joint) for array, columns in arrays.items() for joint, _ in zip(names, columns, strict=False)]
    return _layout("sensor_msgs/msg/JointState", ["", len(names), *names, *arrays.values()], places)


def joint_trajectory_point(joint: str, *, position: str, velocity: str, acceleration: str) -> Layout:
    """Layout of a trajectory_msgs/JointTrajectory with one joint and one point, with these columns, at time_from_start
    0."""
    fields: list[str | int | tuple[str, ...]] = ["", 1, joint, 1, (position,), (velocity,), (acceleration,), (), 0, 0]
    places = [(array, joint) for array in ("positions", "velocities", "accelerations")]
    return _layout("trajectory_msgs/msg/JointTrajectory", fields, places)


def header_stamp_ns(data: bytes) -> int:
    """Stamp in ns of any message that starts with a std_msgs/Header, from its serialised bytes (little endian), at
    least :data:`SHORTEST`."""
    sec, nanosec = _HEADER_STAMP.unpack_from(data, len(ENCAPSULATION))
    return int(sec * NANOSECONDS + nanosec)


def pack_batch(messages: Sequence[tuple[int, bytes]]) -> bytes:
    """Serialise a batch of messages: when each was made, in ns since the epoch, and its serialised bytes."""
    body = b"".join([piece for made_ns, data in messages for piece in (_MADE.pack(made_ns), data)])
    return _BATCH_HEAD.pack(ENCAPSULATION, 0, 0, len(body)) + body


def unpack_batch(batch: bytes, size: int) -> list[tuple[int, bytes]]:
    """The messages of a serialised batch, as given to :func:`pack_batch`; LayoutMismatch if it is no batch of messages
    of ``size`` bytes each."""
    step = _MADE.size + size
    if len(batch) < _BATCH_HEAD.size:
        raise LayoutMismatch(f"{BATCH_TYPE}: {len(batch)} bytes, {_BATCH_HEAD.size} expected at least")
    encapsulation, dimensions, offset, length = _BATCH_HEAD.unpack_from(batch)
    plain = (encapsulation, dimensions, offset) == (ENCAPSULATION, 0, 0)
    # The middleware may pad a message to a multiple of 4 bytes.
    padding = len(batch) - _BATCH_HEAD.size - length
    if not plain or not 0 <= padding < 4:
        raise LayoutMismatch(f"{BATCH_TYPE}: not a plain array of bytes")
    if length % step:
        raise LayoutMismatch(f"{BATCH_TYPE}: {length} bytes are no multiple of {step}, the size of one message")
    at = range(_BATCH_HEAD.size, _BATCH_HEAD.size + length, step)
    messages = [(_MADE.unpack_from(batch, k)[0], batch[k + _MADE.size : k + step]) for k in at]
    if any(made_ns < 0 for made_ns, _ in messages):
        raise LayoutMismatch(f"{BATCH_TYPE}: a message was made before 1970")
    return messages
