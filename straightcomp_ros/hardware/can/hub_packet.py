"""A CAN frame as the hub passes it on, in one packet of a SOCK_SEQPACKET socket."""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

_HEAD = struct.Struct("<QIB")
LONGEST = _HEAD.size + 64


class Flag(enum.IntFlag):
    """Kind of a frame."""

    EXTENDED = 1
    REMOTE = 2
    ERROR = 4
    FD = 8
    BIT_RATE_SWITCH = 16


# Plain numbers, since each operation on an IntFlag takes some microseconds. FD_FRAME is what this package sends.
EXTENDED, REMOTE, ERROR = int(Flag.EXTENDED), int(Flag.REMOTE), int(Flag.ERROR)
FD_FRAME = int(Flag.FD | Flag.BIT_RATE_SWITCH)


class Frame(NamedTuple):
    """A frame on the bus; ``stamp_ns`` is the system time at which it was sent, ns since the epoch."""

    stamp_ns: int
    identifier: int
    flags: int
    data: bytes


def to_packet(frame: Frame) -> bytes:
    return _HEAD.pack(*frame[:3]) + frame.data


def from_packet(packet: bytes) -> Frame:
    return Frame(*_HEAD.unpack_from(packet), packet[_HEAD.size :])


def priority(packet: bytes) -> tuple[int, int, int]:
    """Sort key by which frames win the bus, the lowest first: by the bits of the identifier."""
    _, identifier, flags = _HEAD.unpack_from(packet)
    if flags & EXTENDED:
        # After eleven equal bits a standard frame wins.
        return identifier >> 18, 1, identifier & 0x3FFFF
    return identifier, 0, 0
