"""What only a simulation knows of a sample, in a frame of its own. No board sends it.

It comes right before the encoder frame of the same sample, on CAN FD only: it fills the longest frame there is.
"""

from __future__ import annotations

import struct
import zlib

from straightcomp_ros.hardware.can.frames import FrameError
from straightcomp_ros.hardware.interface import Truth

_HEAD = struct.Struct("<II")
_CONTENT = struct.Struct("<6d8x")
TRUTH_BYTES = _HEAD.size + _CONTENT.size


def truth_payload(counter: int, truth: Truth) -> bytes:
    """Sample counter, CRC-32 of what follows with the counter as its start, six doubles in SI units, eight bytes of
    zero."""
    content = _CONTENT.pack(*truth)
    return _HEAD.pack(counter, zlib.crc32(content, counter)) + content


def truth_of(payload: bytes) -> tuple[int, Truth]:
    """Sample counter and truth.

    Raises:
        FrameError: the frame is damaged.
    """
    if len(payload) != TRUTH_BYTES:
        raise FrameError("truth")
    counter, seal = _HEAD.unpack_from(payload)
    content = payload[_HEAD.size :]
    if seal != zlib.crc32(content, counter):
        raise FrameError("truth")
    return counter, Truth(*_CONTENT.unpack(content))
