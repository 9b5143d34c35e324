"""Packs several messages of a stream into one; :mod:`straightcomp_ros.runtime.streams` says why.

A batch is a std_msgs/UInt8MultiArray. Its data are the messages one after the other, each serialised as if published
alone and preceded by the time at which it was made: int64, ns since the epoch, little endian. All messages of a stream
have the same size.
"""

import struct
from collections.abc import Sequence

from straightcomp_ros.messages.cdr import ENCAPSULATION, LayoutMismatch

BATCH_TYPE = "std_msgs/msg/UInt8MultiArray"
_HEAD = struct.Struct("<4sIII")
"""Encapsulation, number of dimensions, data_offset, number of bytes."""
_TIME = struct.Struct("<q")


def pack_batch(messages: Sequence[tuple[int, bytes]]) -> bytes:
    """Serialise a batch of messages: when each was made, in ns since the epoch, and its serialised bytes."""
    parts = [b""]
    for made_ns, data in messages:
        parts.append(_TIME.pack(made_ns))
        parts.append(data)
    size = sum(map(len, parts))
    parts[0] = _HEAD.pack(ENCAPSULATION, 0, 0, size)
    return b"".join(parts)


def unpack_batch(batch: bytes, size: int) -> list[tuple[int, bytes]]:
    """The messages of a serialised batch, as given to :func:`pack_batch`; ``size`` is the size of one message in bytes.

    Raises:
        LayoutMismatch: the bytes are not a batch of such messages.
    """
    step = _TIME.size + size
    if len(batch) < _HEAD.size:
        raise LayoutMismatch(f"{BATCH_TYPE}: {len(batch)} bytes, {_HEAD.size} expected at least")
    encapsulation, dimensions, offset, length = _HEAD.unpack_from(batch)
    plain = (encapsulation, dimensions, offset) == (ENCAPSULATION, 0, 0)
    # The middleware may pad a message to a multiple of 4 bytes.
    padding = len(batch) - _HEAD.size - length
    if not plain or not 0 <= padding < 4:
        raise LayoutMismatch(f"{BATCH_TYPE}: not a plain array of bytes")
    if length % step:
        raise LayoutMismatch(f"{BATCH_TYPE}: {length} bytes are no multiple of {step}, the size of one message")
    at = range(_HEAD.size, _HEAD.size + length, step)
    messages = [(_TIME.unpack_from(batch, k)[0], batch[k + _TIME.size : k + step]) for k in at]
    if any(made_ns < 0 for made_ns, _ in messages):
        raise LayoutMismatch(f"{BATCH_TYPE}: a message was made before 1970")
    return messages
