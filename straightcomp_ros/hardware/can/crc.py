"""CRC-8 of AUTOSAR E2E profile 1: polynomial SAE J1850 (0x1D), start and final XOR zero, both bytes of the data id.

The data id is not sent: both ends run it through the CRC before the payload, so that a frame under a wrong
identifier fails its check. Here the data id is the frame's CAN identifier. The polynomial is primitive, of
order 255: it finds any two wrong bits in frames of this length, and any burst of up to eight; of all else, 255 in 256.

Two bytes a step, by a table of 64 KiB, and no loop: at 2 kHz and two frames a period the CRC is most of what a
frame costs. The first byte of a payload is the place of the CRC itself and is left out.

Source: AUTOSAR FO PRS_E2EProtocol, profile 1, E2E_P01_DATAID_BOTH.
"""

from __future__ import annotations

import struct

_POLYNOMIAL = 0x1D
_FIVE, _EIGHT, _SIXTEEN = struct.Struct("<2HB"), struct.Struct("<4H"), struct.Struct("<8H")


def _byte_table() -> bytes:
    rows = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        rows.append(crc)
    return bytes(rows)


_BYTE = _byte_table()
_PAIR = bytes(_BYTE[_BYTE[first] ^ second] for second in range(256) for first in range(256))
"""CRC after two bytes, the first of them, in the low half of the index, already with the CRC so far."""


def start_value(data_id: int) -> int:
    """Where the CRC of a payload begins: that of the 16-bit data id, low byte first.

    One step back from there: the place of the CRC in the payload then counts as a byte of zero.
    """
    return _BYTE.index(_BYTE[_BYTE[data_id & 0xFF] ^ data_id >> 8])


def crc_of_5(payload: bytes, start: int) -> int:
    """CRC of a payload of five bytes."""
    a, b, c = _FIVE.unpack(payload)
    return _BYTE[_PAIR[_PAIR[start ^ a & 0xFF00] ^ b] ^ c]


def crc_of_8(payload: bytes, start: int) -> int:
    """CRC of a payload of eight bytes."""
    pair = _PAIR
    a, b, c, d = _EIGHT.unpack(payload)
    return pair[pair[pair[pair[start ^ a & 0xFF00] ^ b] ^ c] ^ d]


def crc_of_16(payload: bytes, start: int) -> int:
    """CRC of a payload of sixteen bytes."""
    pair = _PAIR
    a, b, c, d, e, f, g, h = _SIXTEEN.unpack(payload)
    return pair[pair[pair[pair[pair[pair[pair[pair[start ^ a & 0xFF00] ^ b] ^ c] ^ d] ^ e] ^ f] ^ g] ^ h]
