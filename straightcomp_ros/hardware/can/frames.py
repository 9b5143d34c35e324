"""The frames of the board, packed and unpacked by integer shifts; config/straightcomp.dbc describes the same for tools.

All fields are in Intel byte order, bit 0 first. Byte 0 is the CRC, the low half of byte 1 the alive counter, as in
AUTOSAR E2E profile 1. A frame for CAN FD begins as its classic sibling does and goes on with more fields.

The CRC is CRC-8 with polynomial 0x1D (SAE J1850), start and final XOR zero. It runs over both bytes of the data id,
which is not sent, and then over the payload without its first byte. The data id is the CAN identifier: a frame under a
wrong identifier fails its check. The polynomial is primitive, of order 255: in frames of this length it finds any two
wrong bits and any error burst of up to eight bits; of all other errors, 255 in 256. Source: AUTOSAR FO PRS_E2EProtocol,
profile 1, E2E_P01_DATAID_BOTH.

Numbers are in counts: positions 0.1 µm, currents 0.1 mA.
"""

import enum
import struct
from typing import NamedTuple

POSITION_COUNT, CURRENT_COUNT = 1e-7, 1e-4
"""m and A"""
X_LIMIT, Y_LIMIT, CURRENT_LIMIT = 2**25 - 1, 2**19 - 1, 2**15 - 1
"""Largest counts that are sent, to both sides."""
ALIVE_MODULUS = 15
"""The alive counter runs from 0 to 14; profile 1 reserves 15 for "not valid"."""
COUNTER_MODULUS = ALIVE_MODULUS * 2**28
"""Modulus of the sample counter: a multiple of 15 and of 256, so that alive counter and echo continue when it wraps."""
CURRENT_EVERY = 10
"""On a classic bus the coil current comes with every tenth sample."""
BOOT_UP, OPERATIONAL = 0x00, 0x05
"""Content of the heartbeat, as in CiA 301."""

_POLYNOMIAL = 0x1D
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
    """A frame fails its check; its text is the name under which such frames are counted."""


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
    return amplifier | fault << 2 | encoders_valid << 5


def amplifier_of(status: int) -> int:
    """State of the amplifier in the status; not always a member of :class:`Amplifier`."""
    return status & 3


def fault_of(status: int) -> BoardFault:
    """Board's fault in the status."""
    return BoardFault(status >> 2 & 7)


def encoders_valid(status: int) -> bool:
    """Whether both readings of this sample are good."""
    return bool(status & 32)


def _crc_table() -> bytes:
    table = []
    for crc in range(256):
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        table.append(crc)
    return bytes(table)


_CRC = _crc_table()


def start_value(data_id: int) -> int:
    """CRC of the 16-bit data id, low byte first: where the CRC of a payload begins."""
    return _CRC[_CRC[data_id & 0xFF] ^ data_id >> 8]


def crc_of(payload: bytes, start: int) -> int:
    """CRC of a payload without its first byte, which is the place of the CRC itself."""
    crc, table = start, _CRC
    for byte in payload[1:]:
        crc = table[crc ^ byte]
    return crc


def _sealed(layout: struct.Struct, start: int, first: int, *fields: int) -> bytes:
    """The payload of these fields with its CRC in the low byte of the first."""
    return layout.pack(first | crc_of(layout.pack(first, *fields), start), *fields)


def _checked(layout: struct.Struct, start: int, payload: bytes) -> tuple[int, ...]:
    """The fields of a payload whose length and CRC are right."""
    if len(payload) != layout.size:
        raise FrameError("length")
    if payload[0] != crc_of(payload, start):
        raise FrameError("crc")
    return layout.unpack(payload)


def _check_range(name: str, value: int, limit: int) -> None:
    if not -limit <= value <= limit:
        raise ValueError(f"{name} of {value} counts does not fit its frame; allowed: ±{limit}")


# A named tuple from a plain one, without the class's own constructor, which takes twice the time.
_named = tuple.__new__


class Codec:
    """Packs and unpacks the frames of one node.

    ``pack_…`` raises ValueError where a number does not fit its field; ``unpack_…``, its inverse, raises
    :class:`FrameError` for a wrong length, CRC or alive counter. ``fd`` selects the frames for CAN FD.
    """

    def __init__(self, node: int, fd: bool) -> None:
        self.ids = ids = Identifiers(node)
        self.fd = fd
        self.encoder_id = ids.encoder_fd if fd else ids.encoder
        self.command_id = ids.command_fd if fd else ids.command
        self._encoder = _ENCODER_FD if fd else _ENCODER, start_value(self.encoder_id)
        self._command = _COMMAND_FD if fd else _COMMAND, start_value(self.command_id)
        self._current = _CURRENT, start_value(ids.current)
        self._echo_mask = 0xFFFFFFFF if fd else 0xFF

    def pack_encoder(self, frame: Encoder) -> bytes:
        """Payload of an encoder frame: 8 bytes, or 16 for CAN FD."""
        alive, status, x, y, current, counter = frame
        _check_range("x", x, X_LIMIT)
        _check_range("y", y, Y_LIMIT)
        word = alive << 8 | status << 12 | (x & 0x3FFFFFF) << 18 | (y & 0xFFFFF) << 44
        if not self.fd:
            return _sealed(*self._encoder, word)
        _check_range("current", current or 0, CURRENT_LIMIT)
        return _sealed(*self._encoder, word, current or 0, counter or 0, 0)

    def unpack_encoder(self, payload: bytes) -> Encoder:
        word, *of_fd = _checked(*self._encoder, payload)
        current, counter, _ = of_fd or (None, None, None)
        alive = word >> 8 & 15
        if alive >= ALIVE_MODULUS:
            raise FrameError("alive")
        if counter is not None and (counter >= COUNTER_MODULUS or counter % ALIVE_MODULUS != alive):
            raise FrameError("alive")
        # Two's complement: from the unsigned number to the signed one.
        x, y = (word >> 18 & 0x3FFFFFF ^ 0x2000000) - 0x2000000, (word >> 44 ^ 0x80000) - 0x80000
        return _named(Encoder, (alive, word >> 12 & 63, x, y, current, counter))

    def pack_current(self, frame: Current) -> bytes:
        """Payload of a coil current frame, 8 bytes."""
        alive, current, counter = frame
        _check_range("current", current, CURRENT_LIMIT)
        return _sealed(*self._current, 0, alive, current, counter)

    def unpack_current(self, payload: bytes) -> Current:
        _, alive, current, counter = _checked(*self._current, payload)
        if alive & 15 >= ALIVE_MODULUS or counter >= COUNTER_MODULUS:
            raise FrameError("alive")
        return Current(alive & 15, current, counter)

    def pack_command(self, frame: Command) -> bytes:
        """Payload of a command frame: 5 bytes, or 8 for CAN FD."""
        alive, enable, reset, current, echo = frame
        _check_range("current", current, CURRENT_LIMIT)
        return _sealed(*self._command, 0, alive | enable << 4 | reset << 6, current, echo & self._echo_mask)

    def unpack_command(self, payload: bytes) -> Command:
        _, second, current, echo = _checked(*self._command, payload)
        if second & 15 >= ALIVE_MODULUS:
            raise FrameError("alive")
        return _named(Command, (second & 15, second >> 4 & 3, second >> 6, current, echo))
