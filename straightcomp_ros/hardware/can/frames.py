"""The frames of the board, packed and unpacked by integer shifts; config/straightcomp.dbc says the same for tools.

All fields lie in Intel order, bit 0 first. Byte 0 is the CRC, the low half of byte 1 the alive counter, as
AUTOSAR E2E profile 1 has them. A frame for CAN FD begins as its classic sibling does and goes on with more.

Numbers are in counts: positions 0.1 µm, currents 0.1 mA.
"""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

from straightcomp_ros.hardware.can.crc import crc_of_5, crc_of_8, crc_of_16, start_value

POSITION_COUNT = 1e-7
"""m"""
CURRENT_COUNT = 1e-4
"""A"""
X_LIMIT, Y_LIMIT, CURRENT_LIMIT = 2**25 - 1, 2**19 - 1, 2**15 - 1
"""Largest counts that are sent, to both sides."""
ALIVE_MODULUS = 15
"""The alive counter runs from 0 to 14; profile 1 keeps 15 for "not valid"."""
COUNTER_MODULUS = ALIVE_MODULUS * 2**28
"""The sample counter's: a multiple of 15 and of 256, so that alive counter and echo run on over its end."""
CURRENT_EVERY = 10
"""On a classic bus the coil current comes with every tenth sample."""
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
"""Heartbeat's content, as in CiA 301."""

_ENCODER = struct.Struct("<Q")
_ENCODER_FD = struct.Struct("<QhIH")
_CURRENT = struct.Struct("<BBhI")
_COMMAND = struct.Struct("<BBhB")
_COMMAND_FD = struct.Struct("<BBhI")
ENCODER_BYTES, ENCODER_FD_BYTES = _ENCODER.size, _ENCODER_FD.size
CURRENT_BYTES, COMMAND_BYTES, COMMAND_FD_BYTES = _CURRENT.size, _COMMAND.size, _COMMAND_FD.size


class Amplifier(enum.IntEnum):
    """State of the board's amplifier, two bits of the status; zero is no state."""

    OFF = 1
    ON = 2
    FAULT = 3


class BoardFault(enum.IntEnum):
    """Why the board switched off, three bits of the status."""

    NONE = 0
    COMMAND_TIMEOUT = 1
    COMMAND_CHECK = 2
    CURRENT_RANGE = 3
    ENCODER = 4
    OVERCURRENT = 5
    SUPPLY = 6
    INTERNAL = 7


class Switch(enum.IntEnum):
    """Two-bit patterns of ``enable`` and ``reset``; the other two, all zeros and all ones, are faults of the sender."""

    NO = 0b01
    YES = 0b10


class FrameError(ValueError):
    """A frame fails its check; ``reason`` names the counter that it belongs to."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Identifiers:
    """CAN identifiers (11 bits) of a board's frames, laid out as CiA 301 does for node ``node``, 1 to 127."""

    def __init__(self, node: int) -> None:
        self.encoder = 0x180 + node
        self.command = 0x200 + node
        self.current = 0x280 + node
        self.command_fd = 0x300 + node
        self.encoder_fd = 0x380 + node
        # An emulated machine only; no board uses them.
        self.stage_time = 0x400 + node
        self.stage_motion = 0x480 + node
        self.stage_start = 0x500 + node
        self.truth = 0x580 + node
        self.heartbeat = 0x700 + node


class Encoder(NamedTuple):
    """One sample. On a classic bus ``current`` and ``counter`` are None: they come in a frame of their own."""

    alive: int
    status: int
    x: int
    y: int
    current: int | None = None
    counter: int | None = None


class Current(NamedTuple):
    """The coil current with every tenth sample, and that sample's number: classic bus only."""

    alive: int
    current: int
    counter: int


class Command(NamedTuple):
    """What the host asks for; ``echo`` is the number of the sample that it answers, mod 256 on a classic bus."""

    alive: int
    enable: int
    reset: int
    current: int
    echo: int


def status_bits(amplifier: Amplifier, fault: BoardFault, encoders_valid: bool) -> int:
    """The six status bits."""
    return amplifier | fault << 2 | encoders_valid << 5


def amplifier_of(status: int) -> int:
    """Amplifier's state in the status; compare with :class:`Amplifier`."""
    return status & 3


def fault_of(status: int) -> BoardFault:
    """Board's fault in the status."""
    return BoardFault(status >> 2 & 7)


def encoders_valid(status: int) -> bool:
    """Whether both readings of this sample are good."""
    return bool(status & 32)


# A named tuple from a plain one, without the class's own constructor, which takes twice the time.
_named = tuple.__new__


def _refuse(**fields: tuple[int, int]) -> None:
    """Raise ValueError for the first field, (value, limit), that does not fit."""
    for name, (value, limit) in fields.items():
        if not -limit <= value <= limit:
            raise ValueError(f"{name} of {value} counts does not fit its frame; allowed: ±{limit}")


def _encoder_word(alive: int, status: int, x: int, y: int) -> int:
    if not (-X_LIMIT <= x <= X_LIMIT and -Y_LIMIT <= y <= Y_LIMIT):
        _refuse(x=(x, X_LIMIT), y=(y, Y_LIMIT))
    return alive << 8 | status << 12 | (x & 0x3FFFFFF) << 18 | (y & 0xFFFFF) << 44


class Codec:
    """Packs and unpacks the frames of one node.

    ``pack_…`` raises ValueError where a number does not fit its field; ``unpack_…`` raises :class:`FrameError` for a
    wrong length, CRC or alive counter.

    Args:
        node: node id, 1 to 127.
        fd: frames for CAN FD.
    """

    def __init__(self, node: int, fd: bool) -> None:
        self.ids = ids = Identifiers(node)
        self.fd = fd
        self.encoder_id = ids.encoder_fd if fd else ids.encoder
        self.command_id = ids.command_fd if fd else ids.command
        self._encoder_start = start_value(self.encoder_id)
        self._command_start = start_value(self.command_id)
        self._current_start = start_value(ids.current)
        self.unpack_encoder = self._unpack_encoder_fd if fd else self._unpack_encoder_classic
        self._command_layout, self._command_crc, self._echo_mask = (
            (_COMMAND_FD, crc_of_8, 0xFFFFFFFF) if fd else (_COMMAND, crc_of_5, 0xFF)
        )

    def pack_encoder(self, frame: Encoder) -> bytes:
        """Payload of an encoder frame: 8 bytes, or 16 for CAN FD."""
        alive, status, x, y, current, counter = frame
        word = _encoder_word(alive, status, x, y)
        if not self.fd:
            return _ENCODER.pack(word | crc_of_8(_ENCODER.pack(word), self._encoder_start))
        current = current or 0
        if not -CURRENT_LIMIT <= current <= CURRENT_LIMIT:
            _refuse(current=(current, CURRENT_LIMIT))
        crc = crc_of_16(_ENCODER_FD.pack(word, current, counter or 0, 0), self._encoder_start)
        return _ENCODER_FD.pack(word | crc, current, counter or 0, 0)

    def _unpack_encoder_classic(self, payload: bytes) -> Encoder:
        if len(payload) != ENCODER_BYTES:
            raise FrameError("length")
        if payload[0] != crc_of_8(payload, self._encoder_start):
            raise FrameError("crc")
        (word,) = _ENCODER.unpack(payload)
        alive = word >> 8 & 15
        if alive >= ALIVE_MODULUS:
            raise FrameError("alive")
        # Two's complement: from the unsigned number to the signed one.
        x, y = (word >> 18 & 0x3FFFFFF ^ 0x2000000) - 0x2000000, (word >> 44 ^ 0x80000) - 0x80000
        return _named(Encoder, (alive, word >> 12 & 63, x, y, None, None))

    def _unpack_encoder_fd(self, payload: bytes) -> Encoder:
        if len(payload) != ENCODER_FD_BYTES:
            raise FrameError("length")
        if payload[0] != crc_of_16(payload, self._encoder_start):
            raise FrameError("crc")
        word, current, counter, _ = _ENCODER_FD.unpack(payload)
        alive = word >> 8 & 15
        # The remainder is less than the modulus: this finds an alive counter that is none, too.
        if counter >= COUNTER_MODULUS or counter % ALIVE_MODULUS != alive:
            raise FrameError("alive")
        x, y = (word >> 18 & 0x3FFFFFF ^ 0x2000000) - 0x2000000, (word >> 44 ^ 0x80000) - 0x80000
        return _named(Encoder, (alive, word >> 12 & 63, x, y, current, counter))

    def pack_current(self, frame: Current) -> bytes:
        """Payload of a coil current frame, 8 bytes."""
        alive, current, counter = frame
        _refuse(current=(current, CURRENT_LIMIT))
        crc = crc_of_8(_CURRENT.pack(0, alive, current, counter), self._current_start)
        return _CURRENT.pack(crc, alive, current, counter)

    def unpack_current(self, payload: bytes) -> Current:
        """The inverse of :meth:`pack_current`."""
        if len(payload) != CURRENT_BYTES:
            raise FrameError("length")
        crc, alive, current, counter = _CURRENT.unpack(payload)
        if crc != crc_of_8(payload, self._current_start):
            raise FrameError("crc")
        if alive & 15 >= ALIVE_MODULUS or counter >= COUNTER_MODULUS:
            raise FrameError("alive")
        return Current(alive & 15, current, counter)

    def pack_command(self, frame: Command) -> bytes:
        """Payload of a command frame: 5 bytes, or 8 for CAN FD."""
        alive, enable, reset, current, echo = frame
        if not -CURRENT_LIMIT <= current <= CURRENT_LIMIT:
            _refuse(current=(current, CURRENT_LIMIT))
        second, echo, pack = alive | enable << 4 | reset << 6, echo & self._echo_mask, self._command_layout.pack
        return pack(self._command_crc(pack(0, second, current, echo), self._command_start), second, current, echo)

    def unpack_command(self, payload: bytes) -> Command:
        """The inverse of :meth:`pack_command`."""
        layout = self._command_layout
        if len(payload) != layout.size:
            raise FrameError("length")
        crc, second, current, echo = layout.unpack(payload)
        if crc != self._command_crc(payload, self._command_start):
            raise FrameError("crc")
        if second & 15 >= ALIVE_MODULUS:
            raise FrameError("alive")
        return _named(Command, (second & 15, second >> 4 & 3, second >> 6, current, echo))
