"""CRC-8 of AUTOSAR E2E profile 1: polynomial SAE J1850 (0x1D), start and final XOR zero, both bytes of the data id.

The data id is not sent: both ends run it through the CRC before the payload, so that a frame under a wrong
identifier fails its check. Here the data id is the frame's CAN identifier. The polynomial is primitive, of
order 255: it finds any two wrong bits in frames of this length, and any burst of up to eight; of all else, 255 in 256.

Source: AUTOSAR FO PRS_E2EProtocol, profile 1, E2E_P01_DATAID_BOTH.
"""

from __future__ import annotations

_POLYNOMIAL = 0x1D


def _table() -> bytes:
    rows = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        rows.append(crc)
    return bytes(rows)


_TABLE = _table()


def start_value(data_id: int) -> int:
    """CRC of the 16-bit data id, low byte first: where the payload's CRC begins."""
    return _TABLE[_TABLE[data_id & 0xFF] ^ data_id >> 8]


def crc8(payload: bytes, start: int) -> int:
    """CRC of a payload whose first byte is the place of the CRC itself, and is left out."""
    crc = start
    for byte in payload[1:]:
        crc = _TABLE[crc ^ byte]
    return crc
